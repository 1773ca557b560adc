"""Controlword bits 4 to 9 in every mode of operation: all combinations at rest, and each bit alone in motion."""

import struct
from collections.abc import Callable

import pytest
from drive_bench import MS, Bench

from sim_drive.device.cia402 import PowerState
from sim_drive.settings import DriveSettings
from sim_drive.switches import Switches

REACHED, BIT_12, BIT_13 = 0x0400, 0x1000, 0x2000
MODE_BITS = REACHED | BIT_12 | BIT_13
START, HALT = 1 << 4, 1 << 8
"""Bit 4 is new set-point (pp), homing operation start (hm), enable interpolation (ip)."""
COMBINATIONS = [bits << 4 for bits in range(64)]

AT_REST: dict[int, Callable[[int, bool], int]] = {
    0: lambda word, has_started: 0,
    # pp: bit 10 target reached (in a halt: velocity 0), 12 set-point acknowledge, 13 following error.
    1: lambda word, has_started: REACHED | (BIT_12 if word & START else 0),
    # pv: bit 10 target velocity reached, 12 speed is 0, 13 max slippage error.
    3: lambda word, has_started: REACHED | BIT_12,
    # tq: bit 10 target torque reached, 12 and 13 reserved.
    4: lambda word, has_started: REACHED,
    # hm: bit 10 target reached, 12 homing attained, 13 homing error; attained stays when the start bit goes.
    6: lambda word, has_started: REACHED | (BIT_12 if has_started else 0),
    # ip: bit 10 target reached, 12 ip mode active, 13 reserved.
    7: lambda word, has_started: REACHED | (BIT_12 if word & START and not word & HALT else 0),
    # csp, csv, cst: bit 10 reserved, 12 the drive follows the command value, 13 following error.
    8: lambda word, has_started: 0 if word & HALT else BIT_12,
    9: lambda word, has_started: 0 if word & HALT else BIT_12,
    10: lambda word, has_started: 0 if word & HALT else BIT_12,
    # camming: as csp, from the first master position on.
    -2: lambda word, has_started: 0,
}
"""Bits 10, 12 and 13 of an axis at rest, by the controlword's bits, and whether homing has ever been started."""


def bench_in(mode: int) -> Bench:
    bench = Bench(DriveSettings(switches=Switches(home=(100_000.0, 200_000.0))))
    bench.follows = True
    for index in (0x6068, 0x606E, 0x6070):
        bench.must(index, 0, 0, 2)
    for index in (0x6083, 0x6084, 0x609A, 0x60C5, 0x60C6, 0x6085):
        bench.must(index, 0, 400_000, 4)
    bench.must(0x6087, 0, 100_000, 4)
    bench.must(0x60C2, 1, 1, 1)
    if mode == -2:
        assert bench.download(0x3000, 1, b"OK" + struct.pack("<qd", 0, 1.0)) == 0
        bench.must(0x3000, 2, 1, 1)
        bench.must(0x3010, 0, 1, 1)
    return bench


@pytest.mark.parametrize("mode", AT_REST)
def test_every_combination_at_rest(mode: int):
    bench = bench_in(mode)
    bench.must(0x6098, 0, 37, 1)
    bench.enable(mode)
    has_started = False
    wrong: list[str] = []
    for bits in COMBINATIONS:
        bench.control(0x0F)
        bench.run(3 * MS)
        before = bench.statusword & MODE_BITS
        if before != AT_REST[mode](0, has_started):
            wrong.append(f"before {bits:04X}h: {before:04X}h")
        bench.control(0x0F | bits)
        bench.run(3 * MS)
        has_started = has_started or bool(bits & START)
        shown = bench.statusword & MODE_BITS
        if shown != AT_REST[mode](bits, has_started):
            wrong.append(f"{bits:04X}h: {shown:04X}h")
        assert bench.drive.power_state is PowerState.OPERATION_ENABLED, f"{bits:04X}h"
        assert bench.drive.position_demand_counts == 0.0
    assert wrong == []


@pytest.mark.parametrize("mode", AT_REST)
@pytest.mark.parametrize("state_word", [0x00, 0x02, 0x06, 0x07])
def test_no_combination_disturbs_the_commands_of_the_state_machine(mode: int, state_word: int):
    bench = bench_in(mode)
    expected = {0x00: 0x40, 0x02: 0x07, 0x06: 0x21, 0x07: 0x23}[state_word]
    bench.must(0x605A, 0, 6, 2)
    for bits in (0, 0x70, 0x170, 0x370, 0x250, 0x100):
        bench.enable(mode)
        bench.control(state_word | bits)
        bench.run(5 * MS)
        assert bench.statusword & (0x6F if expected != 0x40 else 0x4F) == expected, f"{bits:04X}h"
        bench.control(0x00)


RUNNING = {1: 0x1F, 3: 0x0F, 4: 0x0F, 6: 0x1F, 7: 0x1F, 8: 0x0F, 9: 0x0F, 10: 0x0F, -2: 0x0F}
"""The controlword with which a mode moves the axis."""
STOPS = {(mode, 8) for mode in RUNNING} | {(6, 4), (7, 4)}
"""What stops the axis, by the mode and the bit that is turned round; nothing else does anything to its motion."""


class Moving:
    """An axis at 5000 counts/s, or with 100 per mille of torque; ``go_on`` feeds what its mode needs."""

    def __init__(self, mode: int) -> None:
        self.mode = mode
        self.bench = bench = bench_in(mode)
        self.word = RUNNING[mode]
        self.at = 0
        for index, subindex, value, size in (
            (0x6081, 0, 5000, 4),
            (0x607A, 0, 1_000_000 if mode == 1 else 0, 4),
            (0x60FF, 0, 5000 if mode == 3 else 0, 4),
            (0x6098, 0, 20, 1),
            (0x6099, 1, 5000, 4),
        ):
            bench.must(index, subindex, value, size)
        mapped = {8: 0x607A0020, 9: 0x60FF0020, 10: 0x60710010, -2: 0x30110020}.get(mode)
        if mapped is not None:
            bench.map_rpdo(1, 0x205, 1, [0x60400010, mapped])
            bench.nmt(0x01)
        bench.enable(mode)
        bench.control(self.word)
        if mode == 4:
            bench.must(0x6071, 0, 100, 2)
        self.go_on(100)

    def go_on(self, span_ms: int) -> None:
        for _ in range(span_ms):
            self.at += 5
            if self.mode == 7:
                self.bench.write(0x60C1, 1, self.at, 4)
            elif self.mode in (8, 9, 10, -2):
                value = {8: self.at, -2: self.at, 9: 5000, 10: 100}[self.mode]
                self.bench.put(0x205, struct.pack("<Hh" if self.mode == 10 else "<Hi", self.word, value).hex())
                self.bench.sync()
            self.bench.tick()

    @property
    def is_moving(self) -> bool:
        axis = self.bench.drive.axis
        if self.mode in (4, 10):
            return axis.torque_demand is not None and axis.torque_demand > 50.0
        return axis.demand.velocity_at(self.bench.now_ns) == pytest.approx(5000, rel=0.01)


@pytest.mark.parametrize("bit", range(4, 10))
@pytest.mark.parametrize("mode", RUNNING)
def test_each_bit_alone_in_motion(mode: int, bit: int):
    moving = Moving(mode)
    assert moving.is_moving
    moving.word ^= 1 << bit
    moving.bench.control(moving.word)
    moving.go_on(60)
    assert moving.bench.drive.power_state is PowerState.OPERATION_ENABLED
    assert moving.is_moving is ((mode, bit) not in STOPS)
    if (mode, bit) in STOPS:
        before = moving.bench.drive.position_demand_counts
        moving.go_on(20)
        assert moving.bench.drive.position_demand_counts == before or mode == 4
        if mode in (8, 9, 10, -2):
            assert not moving.bench.statusword & BIT_12


@pytest.mark.parametrize("mode", [1, 3, 4, 6, 9])
def test_after_a_halt_the_motion_goes_on(mode: int):
    moving = Moving(mode)
    moving.word |= HALT
    moving.bench.control(moving.word)
    moving.go_on(60)
    assert not moving.is_moving
    moving.word &= ~HALT
    moving.bench.control(moving.word)
    moving.go_on(60)
    assert moving.is_moving


def test_a_cam_that_went_on_during_a_halt_is_a_jump():
    moving = Moving(-2)
    moving.word |= HALT
    moving.bench.control(moving.word)
    moving.go_on(60)
    stood = moving.bench.shaft
    moving.word &= ~HALT
    moving.go_on(3)
    assert abs(moving.bench.shaft - stood) <= 1
    assert moving.bench.read(0x603F) == 0xFF21


@pytest.mark.parametrize("mode", [1, 3, 9])
def test_without_a_mode_the_axis_comes_to_rest(mode: int):
    moving = Moving(mode)
    moving.bench.must(0x6060, 0, 0, 1)
    moving.bench.run(30 * MS)
    stood = moving.bench.shaft
    moving.bench.run(100 * MS)
    assert moving.bench.shaft == stood
    assert moving.bench.drive.power_state is PowerState.OPERATION_ENABLED
