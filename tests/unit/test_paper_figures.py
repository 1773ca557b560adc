"""The paper's figures from servo ticks made by hand."""

import math

import numpy as np
import pytest

from gateway.reporting.paper_comparison import FirstCycle, TorqueDemand, TunedRun, compare, to_markdown
from gateway.reporting.paper_figures import ServoTicks, reproduce
from mechanism.five_bar import Closure, FiveBar

FIVE_BAR = FiveBar(0.15, 0.25, 0.3, 0.15, (0.0, 0.0), (0.25, 0.0))
PER_TURN = 1024


def hand_made() -> ServoTicks:
    """Four counts a sample on the master; the slave rises by one a sample to 900, rests, and goes back by nine."""
    n = np.arange(3 * PER_TURN + 1)
    in_turn = n % PER_TURN
    slave = np.where(in_turn <= 900, in_turn, np.maximum(900 - 9 * (in_turn - 910), 0))
    slave = np.where((in_turn > 900) & (in_turn < 910), 900, slave)
    demand = np.stack([4.0 * n, slave.astype(float)], axis=1)
    counts = demand.copy()
    # The slave is 3 behind on its way up, 2 on its way back, and once, in the return of the second turn, 40.
    counts[:, 1] -= np.where(in_turn < 900, 3.0, np.where(in_turn > 910, -2.0, 0.0))
    counts[PER_TURN + 950, 1] = demand[PER_TURN + 950, 1] + 40.0
    # The master is 5 ahead at one sample.
    counts[2 * PER_TURN + 10, 0] += 5.0
    torque = np.stack([0.3 * np.ones(len(n)), np.where(in_turn == 5, -0.7, 0.1)], axis=1)
    energy = np.stack([0.02 * n, 0.01 * n], axis=1)
    return ServoTicks(demand, counts, torque, energy)


def test_extremes_and_where_they_are() -> None:
    ticks = hand_made()
    found = reproduce(ticks, ticks.between(1.0, 3.0), FIVE_BAR, Closure.LEFT)
    assert found.revolutions == 2
    assert found.slave.error_extreme_counts == -40.0
    assert found.slave.error_extreme_at_deg == pytest.approx(950 / 1024 * 360)
    assert (found.slave.error_max_counts, found.slave.error_min_counts) == (3.0, -40.0)
    assert found.master.error_extreme_counts == -5.0
    assert found.master.error_extreme_at_deg == pytest.approx(10 / 1024 * 360)
    assert found.return_from_deg == pytest.approx(900 / 1024 * 360)
    assert found.return_to_deg == pytest.approx(1010 / 1024 * 360)
    assert found.slave_maximum_counts == 900.0


def test_velocities_are_one_sample_differences() -> None:
    ticks = hand_made()
    found = reproduce(ticks, ticks.between(1.0, 3.0), FIVE_BAR, Closure.LEFT)
    # 9 a sample in the return; the jump of 38 to the bad sample, and back.
    assert found.slave.velocity_min_counts_per_s == (-9 - 38) * 1024
    assert found.slave.velocity_max_counts_per_s == (-9 + 38) * 1024
    # 4 a sample and 9, then -1.
    assert (found.master.velocity_max_counts_per_s, found.master.velocity_min_counts_per_s) == (9 * 1024, -1024)
    assert found.master_velocity_error_counts_per_s == 5 * 1024


def test_lag_torque_and_energy() -> None:
    ticks = hand_made()
    found = reproduce(ticks, ticks.between(1.0, 3.0), FIVE_BAR, Closure.LEFT)
    # Behind for 900 samples of the way up and 100 of the way back, of 1024; the ends' neighbours may count either way.
    assert found.lag_share == pytest.approx(1000 / 1024, abs=20 / 1024)
    assert (found.slave.torque_max_Nm, found.slave.torque_min_Nm) == (0.1, -0.7)
    assert found.slave.torque_rms_Nm == pytest.approx(math.sqrt((1023 * 0.01 + 0.49) / 1024))
    assert found.master.energy_per_cycle_J == pytest.approx(20.48)
    assert found.power_ratio == pytest.approx(2.0)


def test_end_effector_where_the_crank_is() -> None:
    ticks = hand_made()
    found = reproduce(ticks, ticks.between(1.0, 3.0), FIVE_BAR, Closure.LEFT)
    # At 217 deg the slave shows 217/360 x 1024 - 3 counts.
    theta5 = (217.0 / 360.0 * 1024.0 - 3.0) * math.tau / 4096.0
    x, y = FIVE_BAR.end_effector(np.array([math.radians(217.0)]), np.array([theta5]), Closure.LEFT)[0] * 1e3
    assert found.points_mm[0] == pytest.approx((x, y), abs=1e-2)
    assert found.distances_mm[0] == pytest.approx(math.hypot(x + 52.0, y - 147.0), abs=1e-2)


def test_a_window_without_a_revolution_is_refused() -> None:
    ticks = hand_made()
    with pytest.raises(ValueError, match="whole revolution"):
        reproduce(ticks, ticks.between(5.0, 6.0), FIVE_BAR, Closure.LEFT)


def test_rows_say_what_is_met() -> None:
    ticks = hand_made()
    found = reproduce(ticks, ticks.between(1.0, 3.0), FIVE_BAR, Closure.LEFT)
    run = TunedRun("mine", "By hand", "", {}, found, FirstCycle(-5.0, 3.0), FirstCycle(-5.0, 3.0))
    rows = {row.what: row for row in compare([run], (TorqueDemand(1.0, -1.0, 0.5), TorqueDemand(0.1, -0.1, 0.05)))}
    assert rows["servo error, extreme"].is_met == (False,)  # -40 is not -115 +-10
    assert rows["servo lags in"].is_met == (True,)
    assert rows["CV error, extreme"].is_met == (False,)
    assert rows["power, CV : servo"].is_met == (True,)
    assert rows["power, CV : servo"].ours == ("2.00 : 1",)
    assert rows["servo position, maximum"].is_met == (False,)
    text = to_markdown(list(rows.values()), ["mine"])
    assert "| servo error, extreme | counts | −115 | ±10 | −40 ✗ |" in text
