"""How reports and the monitor write a number; here, and light, because a monitor starts without what analyses a run."""

from typing import Final

NOTHING: Final = "–"


def number(value: float | None, decimals: int = 0, *, sign: bool = False) -> str:
    """A figure as text; a dash for None."""
    if value is None:
        return NOTHING
    # Nothing is minus nothing.
    value = round(value, decimals) + 0.0
    text = f"{value:+,.{decimals}f}" if sign else f"{value:,.{decimals}f}"
    return text.replace("-", "−").replace(",", " ")


def row_of_numbers(*values: float | None) -> str:
    """Microseconds beside each other, with their unit."""
    return " / ".join(number(value, 1) for value in values) + " µs"
