"""What the emulated machine's resolvers and meters show, beyond the plain ones."""

from math import floor, sin

from test_machine_emulated import COUNTS_PER_RAD, MS, Bench

from drivers.frame import Frame
from sim_drive.assembly import free_machine
from sim_drive.machine import EmulatedMachine
from sim_drive.machine_axis import MachineAxis
from sim_drive.physics.free_axis import FreeAxisParameters


class SdoBench:
    """Asks node 5 of a machine by SDO, with frames written out."""

    def __init__(self, machine: EmulatedMachine) -> None:
        self.machine = machine
        machine.wake(0)
        machine.take_frames()

    def upload(self, index: int, subindex: int) -> int:
        self.machine.receive(Frame(0x605, bytes([0x40, index & 0xFF, index >> 8, subindex, 0, 0, 0, 0])), 0)
        (answer,) = (frame for frame in self.machine.take_frames() if frame.cob_id == 0x585)
        assert answer.data[:4] == bytes([0x43, index & 0xFF, index >> 8, subindex])
        return int.from_bytes(answer.data[4:], "little", signed=True)


def test_an_eccentric_resolver_errs_once_a_revolution() -> None:
    # 1000 rad/s2 from rest, the error zero at 0.5 rad and 12 counts a quarter of a revolution later.
    axis = MachineAxis(resolver_eccentricity_counts=12.0, resolver_eccentricity_rad=0.5)
    bench = Bench(1, axes=[FreeAxisParameters(0.001, load_torque_Nm=-1.0)], axis=axis)
    drive = bench.drives[0]
    drive.is_brake_released = True
    bench.run_until(180 * MS)
    seen = [int(str(entry[3])) for entry in bench.log if entry[0] == "tick"]
    for n, counts in enumerate(seen):
        angle = 500.0 * (n / 1024) ** 2
        assert counts == floor(angle * COUNTS_PER_RAD + 12.0 * sin(angle - 0.5) + 0.5)
    errors = [counts - 500.0 * (n / 1024) ** 2 * COUNTS_PER_RAD for n, counts in enumerate(seen)]
    assert 11.0 < max(errors) <= 12.5
    assert -12.5 <= min(errors) < -11.0
    # Between two ticks the error goes on with the angle.
    periods = 100.5
    at_ns = round((1 + periods) * 1e9 / 1024)
    bench = Bench(1, axes=[FreeAxisParameters(0.001, load_torque_Nm=-1.0)], axis=axis)
    bench.drives[0].is_brake_released = True
    bench.run_until(at_ns)
    angle = 500.0 * (periods / 1024) ** 2
    assert bench.drives[0].latch(at_ns)[0] == floor(angle * COUNTS_PER_RAD + 12.0 * sin(angle - 0.5) + 0.5)


def test_the_energy_meter_is_read_over_the_bus() -> None:
    machine = free_machine([5])
    client = SdoBench(machine)
    assert [client.upload(0x3040, subindex) for subindex in (1, 2, 3)] == [0, 0, 0]
    meter = machine.plant
    for _ in range(256):
        meter.advance((0.4,), (False,))
    energy = meter.axis_energy(0)
    assert energy.shaft > 1.0
    told = [client.upload(0x3040, subindex) for subindex in (1, 2, 3)]
    assert told == [round(1000.0 * value) for value in (energy.drawn, energy.shaft, energy.copper)]
