"""The reference machine on its cam at 60 rpm, closed loop, with the nominal gains: plant, servo loops and machine."""

from functools import cache
from math import cos, floor, pi
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline
from test_machine_emulated import COUNTS_PER_RAD, SECOND, Bench

from mechanism.five_bar import Elbow, FiveBar

CURVE = Path(__file__).parents[2] / "config" / "desired_path.csv"
CV_GAINS = (8000, 0, 0, 120_000, 120_000)
SERVO_GAINS = (4000, 0, 0, 45_000, 45_000)
LOWER_SERVO_GAINS = (1000, 0, 0, 20_000, 20_000)
RAMP_S = 1.0


@cache
def cam() -> BSpline:
    """theta5(theta2), by plain inverse kinematics and a spline: not the product's own cam."""
    bar = FiveBar(0.15, 0.25, 0.3, 0.15, (0.0, 0.0), (0.25, 0.0))
    rows = np.loadtxt(CURVE, delimiter=",", skiprows=1)
    for elbow in Elbow:
        angles = np.unwrap([bar.servo_angle(x / 1e3, y / 1e3, elbow) for _, x, y in rows])
        if abs(angles[0]) < 0.01:
            theta2 = np.radians([*rows[:, 0], 360.0])
            return make_interp_spline(theta2, [*angles, angles[0]], k=5, bc_type="periodic")
    raise AssertionError("neither elbow starts at zero")


def theta2_at(now_ns: int) -> float:
    """Master: a smooth ramp to 60 rpm within half a turn."""
    t = now_ns * 1e-9
    if t < RAMP_S:
        return pi * (t - RAMP_S / pi * np.sin(pi * t / RAMP_S))
    return pi * RAMP_S + 2.0 * pi * (t - RAMP_S)


def run(servo_gains: tuple[int, ...]) -> tuple[Bench, NDArray[np.float64]]:
    """Two and a half seconds; position errors in counts of the last two turns, one row a tick, columns CV and servo."""
    bench = Bench(five_bar=True, record_ticks=2048)
    cv, servo = bench.drives
    spline = cam()
    cv.demand = lambda now_ns: theta2_at(now_ns) * COUNTS_PER_RAD
    servo.demand = lambda now_ns: float(spline(theta2_at(now_ns) % (2.0 * pi))) * COUNTS_PER_RAD
    cv.gains, servo.gains = CV_GAINS, servo_gains
    cv.power()
    servo.power()
    bench.run_until(3 * SECOND)
    assert bench.plant.torn_at_s is None
    records = list(bench.machine.records)
    return bench, np.array([r.demands_counts for r in records]) - np.array([r.counts for r in records])


def test_the_cam_is_followed_with_the_nominal_gains() -> None:
    bench, errors = run(SERVO_GAINS)
    assert np.max(np.abs(errors[:, 0])) < 15.0
    assert np.max(np.abs(errors[:, 1])) < 40.0
    counts = np.array([record.counts for record in bench.machine.records])
    # 99.78 deg are 1135 counts: the paper's servo maximum, within the following error.
    assert abs(int(counts[:, 1].max()) - 1135) < 20
    assert counts[-1, 0] - counts[0, 0] == floor(2047 / 1024 * 4096 + 0.5) + round(errors[0, 0] - errors[-1, 0])
    torques = np.array([record.torques_Nm for record in bench.machine.records])
    assert 0.5 < np.max(np.abs(torques[:, 1])) < 1.6
    assert 0.5 < np.max(np.abs(torques[:, 0])) < 2.0


def test_lower_gains_give_errors_like_the_papers() -> None:
    _, errors = run(LOWER_SERVO_GAINS)
    assert -140.0 < errors[:, 1].min() < -80.0
    # The greatest lag stands in the return stroke, which begins at about 296 deg.
    worst = int(np.argmin(errors[:, 1]))
    theta2 = theta2_at((1024 + worst + 1) * 1_953_125 // 2) % (2.0 * pi)
    assert cos(theta2 - 5.5) > 0.8


def test_two_runs_are_the_same_to_the_last_bit() -> None:
    first, _ = run(SERVO_GAINS)
    second, _ = run(SERVO_GAINS)
    assert list(first.machine.records) == list(second.machine.records)
