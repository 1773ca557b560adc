"""Errors of the application. The command line answers them with one sentence and an exit status."""

from collections.abc import Sequence


class GatewayError(Exception):
    """The machine, or a check, said no: exit status 1."""


class UsageError(GatewayError):
    """Wrong use or bad input: exit status 2."""


class CommissioningError(GatewayError):
    """One or more drives are not what the configuration says; ``problems`` has a sentence for each finding."""

    def __init__(self, problems: Sequence[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = tuple(problems)
