"""Figures of samples that were made by hand, against what comes out on paper."""

import json
import math

import numpy as np
import pytest
from recording_samples import CONSTANTS, WITHOUT_MECHANISM, steady_run

from gateway.record.sample import Phase, SampleArray, SampleFlag, missed_tpdo_flag
from gateway.reporting.analysis import report_of
from gateway.reporting.figures import SMOOTHING_CYCLES, RunReport
from gateway.reporting.number_text import number
from gateway.reporting.run_data import prepare


def report(samples: SampleArray) -> RunReport:
    return report_of(prepare(samples, WITHOUT_MECHANISM))


def test_following_error_is_demand_minus_actual() -> None:
    samples = steady_run()
    samples["position_actual"][250, 1] = 90  # demand 100: the axis is 10 counts short
    samples["position_actual"][1600, 1] = 104
    axis = report(samples).steady.axes[1]
    assert (axis.following_error_counts.max, axis.following_error_counts.min) == (10.0, -4.0)
    assert axis.following_error_counts.rms == pytest.approx(math.sqrt((10**2 + 4**2) / 2000))
    # record 250 of 1000 a turn is at 90 degrees
    assert axis.following_error_counts.max_abs_at_master_deg == pytest.approx(90.0)
    # 10 counts of 4096 = 0.878906 deg
    assert axis.following_error_deg.max == pytest.approx(0.87890625)
    assert axis.following_error_deg.max_abs_at_master_deg == pytest.approx(90.0)


def test_rms_of_a_sine_is_its_amplitude_over_the_square_root_of_two() -> None:
    samples = steady_run(1000)
    # amplitude 1e6 counts, so that rounding to counts does not matter
    error = np.rint(1e6 * np.sin(2 * math.pi * np.arange(1000) / 1000)).astype(np.int32)
    samples["position_actual"][:, 1] = samples["position_demand"][:, 1] - error
    figures = report(samples).steady.axes[1].following_error_counts
    assert figures.rms == pytest.approx(1e6 / math.sqrt(2), rel=1e-7)
    assert (figures.max, figures.min) == (1e6, -1e6)
    assert figures.max_abs_at_master_deg == pytest.approx(90.0)


def test_an_axis_that_lags_on_its_way_back_has_a_negative_error() -> None:
    samples = steady_run()
    way_back = -10 * np.arange(2000)
    samples["position_demand"][:, 1] = way_back
    samples["position_actual"][:, 1] = way_back + 115
    assert report(samples).steady.axes[1].following_error_counts.min == -115.0


def test_a_missed_tpdo_is_counted_and_leaves_the_figures_of_that_axis_alone() -> None:
    samples = steady_run()
    samples["position_actual"][500] = [-9999, 9999]
    samples["flags"][500] = missed_tpdo_flag(1)
    whole = report(samples)
    assert whole.cycle.counts.missed_tpdo == 1
    assert whole.steady.axes[1].following_error_counts.max == 0.0
    assert whole.steady.axes[1].samples == 1999
    # the other axis' TPDO came: its error is real
    assert whole.steady.axes[0].following_error_counts.max == 2048.0 + 9999.0
    assert whole.steady.axes[1].velocity_actual_counts_per_s.max == 0.0


def test_both_axes_missing_in_one_cycle_are_two_missed_tpdos() -> None:
    samples = steady_run()
    samples["flags"][3] = missed_tpdo_flag(0) | missed_tpdo_flag(1)
    samples["flags"][4] = SampleFlag.MISSED_RPDO_DEADLINE | SampleFlag.OVERRUN
    cycle = report(samples).cycle
    assert (cycle.counts.missed_tpdo, cycle.counts.missed_rpdo_deadline, cycle.counts.overruns) == (2, 1, 1)


def test_velocity_is_the_one_sample_difference_and_the_smoothed_one_spans_ten() -> None:
    samples = steady_run(100)
    # 3 counts a cycle at 1 kHz = 3000 counts/s, with one jump of 1 count more: 4000 counts/s for one sample
    steps = np.full(100, 3)
    steps[50] = 4
    samples["position_actual"][:, 1] = np.cumsum(steps)
    axis = report(samples).steady.axes[1]
    assert (axis.velocity_actual_counts_per_s.max, axis.velocity_actual_counts_per_s.min) == (4000.0, 3000.0)
    assert SMOOTHING_CYCLES == 10
    assert axis.velocity_smoothed_counts_per_s.max == pytest.approx(3100.0)
    assert axis.velocity_smoothed_counts_per_s.min == pytest.approx(3000.0)


def test_velocity_is_not_taken_across_lost_samples() -> None:
    samples = steady_run(100)
    samples["position_actual"][:, 1] = 3 * np.arange(100)
    kept = np.delete(samples, slice(40, 60))
    whole = report(kept)
    assert whole.steady.axes[1].velocity_actual_counts_per_s.max == 3000.0
    assert whole.steady.axes[1].velocity_smoothed_counts_per_s.max == 3000.0
    assert whole.cycle.lost_samples == 20


def test_ramps_count_in_the_whole_run_only_and_a_quick_stop_in_neither() -> None:
    samples = steady_run()
    samples["phase"][:500] = Phase.RAMP_UP
    samples["phase"][1500:] = Phase.RAMP_DOWN
    samples["phase"][1900:] = Phase.QUICK_STOP
    samples["position_actual"][100, 1] = 70
    samples["position_actual"][700, 1] = 95
    samples["position_actual"][1950, 1] = 0
    whole = report(samples)
    assert whole.steady.axes[1].following_error_counts.max == 5.0
    assert whole.whole_run.axes[1].following_error_counts.max == 30.0
    assert whole.phase_counts[Phase.RAMP_UP] == 500
    assert whole.phase_counts[Phase.QUICK_STOP] == 100
    assert (whole.steady.samples, whole.whole_run.samples) == (1000, 1900)


def test_torque_is_per_mille_of_each_axis_own_rated_torque() -> None:
    samples = steady_run()
    samples["torque_actual"] = [1000, -500]
    samples["torque_actual"][::2, 1] = 500
    axes = report(samples).steady.axes
    assert axes[0].torque_actual_nm.max == pytest.approx(1.5)
    assert (axes[1].torque_actual_nm.max, axes[1].torque_actual_nm.min) == (pytest.approx(0.25), pytest.approx(-0.25))
    assert axes[1].torque_actual_nm.rms == pytest.approx(0.25)


def test_displacement_is_the_span_of_the_actual_position() -> None:
    samples = steady_run()
    samples["position_actual"][10, 1] = 0
    samples["position_actual"][20, 1] = 1135
    axis = report(samples).steady.axes[1]
    # the paper's: 1135 counts are 99.76 deg
    assert axis.displacement_deg == pytest.approx(99.755859375)
    assert (axis.position_actual_counts.max, axis.position_actual_counts.min) == (1135.0, 0.0)


def test_positions_that_wrap_are_no_errors_and_no_displacements() -> None:
    samples = steady_run()
    continuous = 2**31 - 1000 + np.arange(2000)
    samples["position_demand"][:, 1] = continuous.astype(np.uint32).view(np.int32)
    samples["position_actual"][:, 1] = (continuous - 7).astype(np.uint32).view(np.int32)
    axis = report(samples).steady.axes[1]
    assert (axis.following_error_counts.max, axis.following_error_counts.min) == (7.0, 7.0)
    assert axis.displacement_deg == pytest.approx(1999 * 360 / 4096)
    # one count a cycle of 1 ms
    assert (axis.velocity_actual_counts_per_s.max, axis.velocity_actual_counts_per_s.min) == (1000.0, 1000.0)


@pytest.mark.parametrize(("records", "cycles"), [(999, 0), (1000, 1), (1999, 1), (2000, 2), (2500, 2)])
def test_machine_cycles_are_whole_revolutions_at_constant_speed(records: int, cycles: int) -> None:
    samples = steady_run(3000)
    samples["phase"][records:] = Phase.RAMP_DOWN
    assert report(samples).machine_cycles == cycles


def test_timing_percentiles_were_really_seen_and_the_first_record_has_no_period() -> None:
    samples = steady_run(101)
    # deviations of 1 .. 100 us, alternately early and late; record 0 has no SYNC before it
    deviation = np.arange(1, 101) * 1000
    samples["sync_period_ns"][1:] = 1_000_000 + np.where(np.arange(100) % 2, -deviation, deviation)
    samples["wake_lateness_ns"] = np.arange(101) * 10_000
    samples["rpdo_lead_ns"][7] = -50_000
    cycle = report(samples).cycle
    assert (cycle.sync_period_deviation_us.p50, cycle.sync_period_deviation_us.max) == (51.0, 100.0)
    assert cycle.sync_period_deviation_us.p99 == 100.0
    assert (cycle.wake_lateness_us.p50, cycle.wake_lateness_us.p99, cycle.wake_lateness_us.max) == (
        500.0,
        990.0,
        1000.0,
    )
    assert (cycle.rpdo_lead_us.min, cycle.rpdo_lead_us.max) == (-50.0, 400.0)
    assert cycle.loop_cpu_us_per_cycle == pytest.approx(60.0)
    assert (cycle.tpdo_arrival_us.max, cycle.count) == (300.0, 101)


def test_end_effector_of_a_machine_without_errors_is_where_it_should_be() -> None:
    samples = steady_run()
    data = prepare(samples, CONSTANTS)
    assert data.actual_mm is not None
    # By hand: theta2 = 0, theta5 = 100 counts = 8.7890625 deg. A = (150, 0), D = 250 + 150 (cos, sin) = (398.2386,
    # 22.9196). C is 250 from A and 300 from D, left of the line from A to D.
    x, y = data.actual_mm[0]
    assert math.hypot(x - 150.0, y) == pytest.approx(250.0)
    assert math.hypot(x - 398.23864, y - 22.91958) == pytest.approx(300.0, abs=1e-4)
    assert 248.23864 * y - 22.91958 * (x - 150.0) > 0
    report = report_of(data)
    assert report.steady.end_effector_error_mm.max == pytest.approx(0.0, abs=1e-9)


def test_end_effector_error_of_a_crank_that_lags_is_geometry() -> None:
    samples = steady_run()
    # The servo link holds; with the crank 4 counts behind at theta2 = 0, C moves by its Jacobian: compare with a
    # finite difference of the construction above.
    samples["position_actual"][0, 0] = -4
    data = prepare(samples, CONSTANTS)
    assert data.actual_mm is not None
    angle = -4 * 2 * math.pi / 4096
    a = np.array([150 * math.cos(angle), 150 * math.sin(angle)])
    five = 100 * 2 * math.pi / 4096
    d = np.array([250 + 150 * math.cos(five), 150 * math.sin(five)])
    distance = np.linalg.norm(d - a)
    along = (250**2 - 300**2 + distance**2) / (2 * distance)
    unit = (d - a) / distance
    expected = a + along * unit + math.sqrt(250**2 - along**2) * np.array([-unit[1], unit[0]])
    assert data.actual_mm[0] == pytest.approx(expected, abs=1e-9)
    report = report_of(data)
    assert report.steady.end_effector_error_mm.max == pytest.approx(
        float(np.linalg.norm(data.actual_mm[0] - data.actual_mm[1000])), rel=1e-9
    )


def test_table_ii_interpolates_between_samples_at_the_actual_input() -> None:
    samples = steady_run(2000)
    # Servo link at rest, so C depends on the actual crank angle alone, wherever the demand is.
    samples["position_actual"][:, 0] -= 40
    data = prepare(samples, CONSTANTS)
    rows = report_of(data).table_ii
    assert [row.point.cv_deg for row in rows] == [217.0, 102.0, 4.0]
    assert [row.passes for row in rows] == [2, 2, 2]
    for row in rows:
        angle = math.radians(row.point.cv_deg)
        a = np.array([150 * math.cos(angle), 150 * math.sin(angle)])
        assert row.actual_mm is not None
        assert math.dist(row.actual_mm, a) == pytest.approx(250.0, abs=0.01)


def test_another_machine_is_not_held_against_the_papers_points() -> None:
    assert report(steady_run()).table_ii == ()


def test_json_of_a_run_that_never_moved_has_every_key_and_no_nan() -> None:
    samples = steady_run(10)
    samples["phase"] = Phase.COMMISSIONING
    moved = report(steady_run()).to_json()
    still = report(samples).to_json()
    empty = report(steady_run(0)).to_json()
    for other in (still, empty):
        json.dumps(other, allow_nan=False)
        assert _keys(other) == _keys(moved)
    assert still["axes"]["servo"]["following_error_counts"] == {
        "max": None,
        "min": None,
        "rms": None,
        "max_abs_at_master_deg": None,
    }
    assert still["machine_cycles"] == 0


def _keys(value: object) -> object:
    return {key: _keys(inner) for key, inner in value.items()} if isinstance(value, dict) else None


def test_json_has_the_keys_that_scripts_rely_on() -> None:
    result = report(steady_run()).to_json()
    for name in ("cv", "servo"):
        axis = result["axes"][name]
        assert set(axis["following_error_counts"]) == {"max", "min", "rms", "max_abs_at_master_deg"}
        assert set(axis["position_actual_counts"]) == {"max", "min"}
        assert set(axis["velocity_actual_counts_per_s"]) == {"max", "min"}
        assert set(axis["demand_velocity_rad_per_s"]) == {"max", "min"}
        assert set(axis["torque_actual_Nm"]) == {"max", "min", "rms"}
    assert set(result["end_effector_error_mm"]) == {"max", "rms"}
    assert {"period_s", "count", "missed_tpdo", "missed_rpdo_deadline", "overruns", "loop_cpu_us_per_cycle"} <= set(
        result["cycle"]
    )
    assert set(result["cycle"]["sync_period_deviation_us"]) == {"p50", "p99", "max"}
    assert {"machine_cycles", "recording", "stopped_by", "whole_run"} <= set(result)


@pytest.mark.parametrize(
    ("value", "decimals", "sign", "text"),
    [
        (None, 0, False, "–"),
        (-115.2, 0, True, "−115"),
        (12288.0, 0, True, "+12 288"),
        (0.61071, 3, False, "0.611"),
        (-0.04, 1, True, "+0.0"),
        (-0.04, 1, False, "0.0"),
    ],
)
def test_numbers_are_set_with_a_minus_and_thin_groups(
    value: float | None, decimals: int, sign: bool, text: str
) -> None:
    assert number(value, decimals, sign=sign) == text
