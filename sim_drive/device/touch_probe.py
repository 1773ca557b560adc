"""Touch probe (CiA 402-2, clause 18): positions latched at the edges of inputs, or at index pulses."""

from typing import Final

from drivers import objects
from sim_drive.device.motion import Motion, wrap_int32
from sim_drive.switches import DigitalInput

_ENABLE: Final = 1 << 0
_CONTINUOUS: Final = 1 << 1
_INDEX: Final = 1 << 2
_POSITIVE: Final = 1 << 4
_NEGATIVE: Final = 1 << 5
_STORED_POSITIVE: Final = 1 << 1
_STORED_NEGATIVE: Final = 1 << 2
_SECOND: Final = 8
"""Bits by which the second probe's bits in 60B8h and 60B9h are shifted."""
PROBE_INPUTS: Final = (DigitalInput.HOME, DigitalInput.POSITIVE_LIMIT)
"""What is wired to the inputs of touch probes 1 and 2."""


class _Probe:
    __slots__ = ("_entries", "_shift", "_switch", "armed", "function", "status")

    def __init__(self, number: int, motion: Motion, indices: tuple[int, int]) -> None:
        self._shift = _SECOND * number
        self._switch = PROBE_INPUTS[number]
        self._entries = tuple(motion.entry(index) for index in indices)
        self.function = 0
        self.armed = 0
        """Edges that are still to be latched, as bits of the status."""
        self.status = 0

    def set(self, function: int) -> None:
        """Take the probe's bits of 60B8h; a change of them arms it anew."""
        function = function >> self._shift & 0x3F
        if function == self.function:
            return
        self.function = function
        self.status = 1 if function & _ENABLE else 0
        self.armed = 0
        if function & _ENABLE:
            self.armed = (_STORED_POSITIVE if function & _POSITIVE else 0) | (
                _STORED_NEGATIVE if function & _NEGATIVE else 0
            )

    def look(self, motion: Motion, before: int, after: int) -> None:
        """See what has passed between two servo ticks."""
        switches = motion.settings.switches
        if self.function & _INDEX:
            direction = 1 if after > before else -1
            # A pulse has no second edge: it is latched as the positive one.
            pulse = switches.next_index(before + direction, direction, motion.settings.counts_per_revolution)
            if (after - pulse) * direction >= 0:
                self._latch(_STORED_POSITIVE, pulse, motion)
            return
        was, is_on = switches.inputs(before) & self._switch, switches.inputs(after) & self._switch
        if was != is_on:
            self._latch(
                _STORED_POSITIVE if is_on else _STORED_NEGATIVE, switches.edge(self._switch, before, after), motion
            )

    def _latch(self, edge: int, counts: int, motion: Motion) -> None:
        if not self.armed & edge:
            return
        self._entries[0 if edge == _STORED_POSITIVE else 1].value = wrap_int32(motion.user_position(counts))
        self.status |= edge
        if not self.function & _CONTINUOUS:
            self.armed &= ~edge


class TouchProbe:
    """Both touch probes: function 60B8h, status 60B9h, and latched positions 60BAh to 60BDh.

    Bits of 60B8h, shifted by 8 for probe 2: 0 enables, 1 latches again and again, 2 takes the index pulse for the
    input, 4 and 5 are the positive and the negative edge. Probe 1 listens to the home switch, probe 2 to the positive
    limit switch. A position is that at which a capture input would have latched it.
    """

    __slots__ = ("_before", "_function", "_motion", "_probes", "_status", "is_enabled")

    def __init__(self, motion: Motion) -> None:
        self._motion = motion
        self._function = motion.entry(objects.TOUCH_PROBE_FUNCTION)
        self._function.on_write = self._on_function
        self._status = motion.entry(objects.TOUCH_PROBE_STATUS)
        self._probes = (
            _Probe(0, motion, (objects.TOUCH_PROBE_1_POSITIVE_EDGE, objects.TOUCH_PROBE_1_NEGATIVE_EDGE)),
            _Probe(1, motion, (objects.TOUCH_PROBE_2_POSITIVE_EDGE, objects.TOUCH_PROBE_2_NEGATIVE_EDGE)),
        )
        self._before = 0
        self.is_enabled = False
        """Whether ``on_tick`` has anything to look for."""

    def restore(self) -> None:
        """Disarm both probes."""
        self._on_function(0, 0)

    def _on_function(self, value: int, now_ns: int) -> None:
        for probe in self._probes:
            probe.set(value)
        if not self.is_enabled:
            self._before = self._motion.shaft_counts
        self.is_enabled = any(probe.armed for probe in self._probes)
        self._show()

    def _show(self) -> None:
        self._status.value = self._probes[0].status | self._probes[1].status << _SECOND

    def on_tick(self) -> None:
        """Look at what the axis has passed since the tick before."""
        motion = self._motion
        before = self._before
        self._before = after = motion.shaft_counts
        if after == before:
            return
        for probe in self._probes:
            if probe.armed:
                probe.look(motion, before, after)
        self.is_enabled = any(probe.armed for probe in self._probes)
        self._show()
