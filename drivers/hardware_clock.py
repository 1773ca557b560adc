"""Maps the stamps of a CAN controller's own clock onto the clock that the hosts run on; a core without I/O.

A controller stamps a frame when it has been on the bus, to the microsecond, but by a clock of its own: of any epoch, up
to some 100 parts per million fast or slow, sometimes of 32 bits of microseconds. The kernel's stamp of the same frame
is by our clock, but late, by an interrupt and a softirq that take now 5 us and now 500. The least lateness of a span is
nearly constant: it ties both clocks together, and the hardware's stamp of every frame then tells when that was.
"""

from typing import Final

WINDOW_NS: Final = 250_000_000
"""Span of which the least lateness counts."""
PAUSE_NS: Final = 4 * WINDOW_NS
"""After so long without a frame its offset is looked for anew; the drift stays what it was."""
STEP_NS: Final = 20_000_000
"""A stamp that is this far from where it should be is of a clock that has been set anew, or of a host that slept."""
MAX_DRIFT: Final = 500e-6
"""Of a quartz, with room to spare."""
MAX_SLEW_NS: Final = 250_000
"""Correction of a window at most; it is slewed in over the next one, at 1000 parts per million."""
DRIFT_SHARE: Final = 0.25
"""Of a window's correction that is taken for drift: with this what is left of an error halves with every window."""
WRAP_NS: Final = (1 << 32) * 1000
"""Where a counter of 32 bits of microseconds begins anew: after 71.6 minutes."""


class HardwareClock:
    """Instants of arrival, by hardware stamps, on the clock of the software's stamps.

    The result is never later than the software's stamp, never more than ``STEP_NS`` before it, and never runs backwards
    as long as the software's stamps do not.
    """

    __slots__ = (
        "_anchor_ns",
        "_doubted_since_ns",
        "_is_first_window",
        "_last_hardware_ns",
        "_last_ns",
        "_last_software_ns",
        "_least_ns",
        "_offset_ns",
        "_pending_ns",
        "_wrapped_ns",
        "drift",
        "step_count",
    )

    def __init__(self) -> None:
        self.drift = 0.0
        """By how much the hardware's clock is slow, as a share: 1e-4 is 100 parts per million."""
        self.step_count = -1
        """How often the hardware's clock has been set anew since the first frame."""
        self._last_ns = 0
        self._begin(0, 0)
        self.step_count = -1

    def arrival_ns(self, hardware_ns: int, software_ns: int) -> int:
        """When the frame arrived that was stamped ``hardware_ns`` by the controller, ``software_ns`` by the kernel."""
        if self.step_count < 0:
            self._begin(hardware_ns, software_ns)
        hardware_ns = self._unwrap(hardware_ns, software_ns)
        since_ns = hardware_ns - self._anchor_ns
        # Against the line as it will be when the last correction is all in; the sight of it is of the line as it is.
        late_ns = software_ns - hardware_ns - self._offset_ns - self.drift * since_ns
        if not -STEP_NS <= late_ns <= STEP_NS:
            return self._doubt(hardware_ns, late_ns, software_ns)
        self._doubted_since_ns = 0
        if since_ns > PAUSE_NS:
            self._anchor(hardware_ns, software_ns)
            since_ns, late_ns = 0, 0.0
        if late_ns < self._least_ns:
            self._least_ns = late_ns
            if self._is_first_window:
                # Nothing is known yet: the best frame so far is believed at once.
                self._offset_ns += late_ns
                self._least_ns = late_ns = 0.0
        if since_ns >= WINDOW_NS:
            self._correct(since_ns, hardware_ns)
            late_ns -= self._pending_ns
            since_ns = 0
        pending_ns = self._pending_ns * (1.0 - since_ns / WINDOW_NS)
        early_ns = min(max(round(late_ns + pending_ns), 0), STEP_NS)
        return self._in_order(software_ns - early_ns, software_ns)

    def _in_order(self, arrival_ns: int, software_ns: int) -> int:
        if arrival_ns < self._last_ns:
            arrival_ns = min(self._last_ns, software_ns)
        self._last_ns = arrival_ns
        return arrival_ns

    def _unwrap(self, hardware_ns: int, software_ns: int) -> int:
        """The stamp on a line that goes on where a counter has begun anew."""
        hardware_ns += self._wrapped_ns
        elapsed_ns = software_ns - self._last_software_ns
        if abs(hardware_ns - self._last_hardware_ns + WRAP_NS - elapsed_ns) < STEP_NS:
            self._wrapped_ns += WRAP_NS
            hardware_ns += WRAP_NS
        self._last_hardware_ns, self._last_software_ns = hardware_ns, software_ns
        return hardware_ns

    def _doubt(self, hardware_ns: int, late_ns: float, software_ns: int) -> int:
        """A frame from the future is a clock set anew; a late one may be, and is if all are for a whole window."""
        if not self._doubted_since_ns:
            self._doubted_since_ns = software_ns
        if late_ns < 0.0 or software_ns - self._doubted_since_ns >= WINDOW_NS:
            self._begin(hardware_ns - self._wrapped_ns, software_ns)
        return self._in_order(software_ns, software_ns)

    def _begin(self, hardware_ns: int, software_ns: int) -> None:
        self.step_count += 1
        self.drift = 0.0
        self._wrapped_ns = 0
        self._doubted_since_ns = 0
        self._last_hardware_ns, self._last_software_ns = hardware_ns, software_ns
        self._anchor(hardware_ns, software_ns)

    def _anchor(self, hardware_ns: int, software_ns: int) -> None:
        """Begin a window in which nothing is known of the offset but by this frame."""
        self._anchor_ns = hardware_ns
        self._offset_ns = float(software_ns - hardware_ns)
        self._pending_ns = 0.0
        self._least_ns = 0.0
        self._is_first_window = True

    def _correct(self, since_ns: int, hardware_ns: int) -> None:
        """A window is over: what its best frame was late is slewed in over the next one, and part of it is drift."""
        wanted_ns = _within(self._least_ns, MAX_SLEW_NS)
        self._offset_ns += self.drift * since_ns + wanted_ns
        self._anchor_ns = hardware_ns
        self._pending_ns = wanted_ns
        if not self._is_first_window:
            self.drift = _within(self.drift + DRIFT_SHARE * self._least_ns / since_ns, MAX_DRIFT)
        self._is_first_window = False
        self._least_ns = float(STEP_NS)


def _within(value: float, bound: float) -> float:
    return max(-bound, min(value, bound))
