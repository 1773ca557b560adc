"""A synthesis from its settings to its files: searched, kept safe from interruption, chosen from, written, reported."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from config.schema import GatewayConfig
from gateway.errors import GatewayError
from gateway.running.session import StopRequest, StopSwitch
from gateway.synthesis.choice import choose
from gateway.synthesis.linkage_motion import LinkageMotion, linkage_motion
from gateway.synthesis.machine_files import MachineFiles, write_machine
from gateway.synthesis.report import synthesis_document, torque_figures, write_synthesis_report
from gateway.synthesis.report_plots import SynthesisData
from gateway.synthesis.run_search import SearchRun, SearchStatus
from gateway.synthesis.search_slice import Found
from gateway.synthesis.state_file import SavedSearch, write_state_file
from gateway.synthesis.workers import Workers
from mechanism.errors import SynthesisError, UnreachableError
from mechanism.synthesis.candidate import Candidate
from mechanism.synthesis.task import Term

CHECKPOINT_EVERY_S = 10.0
REPORT_SAMPLES = 720


@dataclass(frozen=True, slots=True, eq=False)
class SynthesisOutcome:
    """What has come of a synthesis. ``problems``: why the machine is of no use as it is, a sentence each."""

    status: SearchStatus
    candidate: Candidate
    machine: MachineFiles
    motion: LinkageMotion
    front: tuple[Found, ...]
    report: Path | None
    problems: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """Everything as JSON values."""
        return synthesis_document(self.status, self.candidate, self.machine, self.motion, self.front)


def resume_path_of(output: Path) -> Path:
    """Where a search that writes ``output`` is kept while it is not finished."""
    return output.with_name(f"{output.stem}.resume.json")


@dataclass(slots=True)
class SynthesisSession:
    """Carries a synthesis through. ``is_speed_fixed``: the machine may not be slowed to keep its drives' limits."""

    status: SearchStatus
    template: GatewayConfig
    output: Path
    is_speed_fixed: bool = False
    clock: Callable[[], float] = time.monotonic

    @property
    def resume_path(self) -> Path:
        """See `resume_path_of`."""
        return resume_path_of(self.output)

    def search(
        self, make_workers: Callable[[], Workers], on_progress: Callable[[SearchStatus], None] = lambda _: None
    ) -> SearchStatus:
        """Search until all starts are finished or a signal asks to end; where it stands is on disk every few seconds.

        Raises OSError, WorkersLostError (what was found until then is on disk) and SynthesisError.
        """
        switch = StopSwitch()
        last_s = self.clock()

        def progressed(status: SearchStatus) -> None:
            nonlocal last_s
            self.status = status
            if self.clock() - last_s >= CHECKPOINT_EVERY_S:
                self.keep()
                last_s = self.clock()
            on_progress(status)

        def is_stopping() -> bool:
            if switch.request is StopRequest.QUICK_STOP:
                raise _AbandonedError
            return switch.request is not StopRequest.NONE

        with switch.installed():
            workers = make_workers()
            try:
                SearchRun(self.status, workers, progressed, is_stopping).run()
            except _AbandonedError:
                pass
            except GatewayError:
                self.keep()
                raise
            finally:
                workers.close()
        if self.status.is_finished:
            self.resume_path.unlink(missing_ok=True)
        else:
            self.keep()
        return self.status

    def keep(self) -> None:
        """Write where the search stands to `resume_path`. Raises OSError."""
        write_state_file(self.resume_path, SavedSearch(self.status, self.template.text, self.is_speed_fixed))

    def finish(self, choice: str | None, report_folder: Path | None) -> SynthesisOutcome:
        """Choose a mechanism, write the machine's files, and the report if asked.

        Raises UsageError for a choice that is none, SynthesisError where nothing feasible was found (it names the
        term that cannot be met), OSError.
        """
        front = self.status.front()
        found = choose(self.status, choice, front, self.template.motion.structural_error_limit_mm * 1e-3)
        candidate = found.candidate(self.status.settings.task)
        missed: str | None = None
        try:
            candidate.require_feasible()
        except SynthesisError as error:
            # A mechanism that misses its curve can be looked at, and is told of by the point that it misses most.
            if error.term != Term.STRUCTURAL_ERROR.value:
                raise
            missed = error.reason
        machine = write_machine(self.output, candidate, self.template, self._remark(), self.is_speed_fixed)
        motion = linkage_motion(machine.config, REPORT_SAMPLES)
        outcome = SynthesisOutcome(
            self.status, candidate, machine, motion, front, report_folder, _problems(missed, machine, motion)
        )
        if report_folder is not None:
            data = SynthesisData(motion, self.status, candidate, front, found if front else None, outcome.problems)
            write_synthesis_report(report_folder, data, machine, outcome.document())
        return outcome

    def _remark(self) -> str:
        settings = self.status.settings
        ended = "" if self.status.is_finished else "; interrupted before its end"
        terms = ", ".join(f"{entry.term.value} {entry.weight:g}" for entry in settings.task.terms)
        return (
            f"Found by drive-gateway synthesize: method {settings.method.value}, seed {settings.seed}, "
            f"starts {settings.starts}, budget {settings.budget}{ended}.\nWeights: {terms}."
        )


class _AbandonedError(Exception):
    """The user does not want to wait for the slices in hand."""


def _problems(missed: str | None, machine: MachineFiles, motion: LinkageMotion) -> tuple[str, ...]:
    """``missed``: what tells of a point that is further away than its tolerance; None where there is none."""
    problems = [] if missed is None else [missed]
    for error in machine.violations:
        if isinstance(error, UnreachableError) and error.bound_m > 0.0:
            if missed is None:
                problems.append(f"the term {Term.STRUCTURAL_ERROR.value} cannot be met within the bounds: {error}")
        else:
            problems.append(str(error))
    axes = zip(machine.config.axis_names, machine.config.ordered_axes, torque_figures(motion), strict=True)
    for name, axis, (_, low, high, rms) in axes:
        for what, value, limit in (
            ("peaks at", max(-low, high), axis.emulation.torque_limit_Nm),
            ("is in the RMS", rms, axis.rated_torque_Nm),
        ):
            if value > limit:
                problems.append(f"axes.{name}: the torque over the cycle {what} {value:.3f} N m, bound {limit:g} N m")
    return tuple(problems)
