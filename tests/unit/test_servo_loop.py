"""The position controller against eq (5) and eq (6) worked by hand."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_drive.physics.servo import OUTPUT_MAXIMUM, OUTPUT_MINIMUM, VOLT_PER_UNIT, DemandResolution, ServoLoop

NM_PER_VOLT = 0.45
NM_PER_UNIT = VOLT_PER_UNIT * NM_PER_VOLT


def started(
    demand: float = 0.0, actual: int = 0, resolution: DemandResolution = DemandResolution.UNROUNDED_DIFFERENCE
) -> ServoLoop:
    servo = ServoLoop(resolution)
    servo.reset(demand, actual)
    return servo


def test_proportional_term_has_the_papers_scaling() -> None:
    servo = started()
    # 100 counts x 512/256 x 10/2048 V = 0.9765625 V, at 0.45 N m / V.
    assert servo.update(100.0, 0, (512, 0, 0, 0, 0), 0.0, NM_PER_VOLT) == 0.9765625 * 0.45
    assert servo.output_units == 200
    assert servo.error_counts == 100


def test_each_term_by_hand() -> None:
    # From demand 10, actual 8 to demand 15, actual 11: e 2 -> 4, sum 4, e difference 2, p difference 3, d difference 5.
    cases = [
        ((256, 0, 0, 0, 0), 4),
        ((0, 256, 0, 0, 0), 4),
        ((0, 0, 256, 0, 0), 2),
        ((0, 0, 0, 256, 0), -3),
        ((0, 0, 0, 0, 256), 5),
        ((2560, 512, 768, 1024, 1280), 40 + 8 + 6 - 12 + 25),
    ]
    for gains, units in cases:
        servo = started(10.0, 8)
        servo.update(15.0, 11, gains, 0.0, NM_PER_VOLT)
        assert servo.output_units == units, gains


def test_the_sum_goes_on_from_sample_to_sample() -> None:
    servo = started()
    gains = (0, 128, 0, 0, 0)
    outputs: list[int] = []
    for demand in (3.0, 5.0, -2.0):
        servo.update(demand, 0, gains, 0.0, NM_PER_VOLT)
        outputs.append(servo.output_units)
    # Sums 3, 8, 6 by half: 1.5 rounds up to 2.
    assert outputs == [2, 4, 3]


def test_output_is_quantised_to_twelve_bits() -> None:
    servo = started()
    assert servo.update(1.0, 0, (100, 0, 0, 0, 0), 0.0, NM_PER_VOLT) == 0.0
    assert servo.update(1.0, 0, (128, 0, 0, 0, 0), 0.0, NM_PER_VOLT) == NM_PER_UNIT
    assert servo.update(5000.0, 0, (256, 0, 0, 0, 0), 0.0, NM_PER_VOLT) == pytest.approx(2047 * 10 / 2048 * 0.45)
    assert servo.update(-5000.0, 0, (256, 0, 0, 0, 0), 0.0, NM_PER_VOLT) == pytest.approx(-10.0 * 0.45)


def test_torque_offset_shares_the_converter() -> None:
    servo = started()
    assert servo.update(0.0, 0, (0, 0, 0, 0, 0), 0.45, NM_PER_VOLT) == pytest.approx(205 * NM_PER_UNIT)
    assert servo.update(0.0, 0, (0, 0, 0, 0, 0), 99.0, NM_PER_VOLT) == pytest.approx(2047 * NM_PER_UNIT)
    assert servo.update(4.0, 0, (256, 0, 0, 0, 0), -6 * NM_PER_UNIT, NM_PER_VOLT) == pytest.approx(-2 * NM_PER_UNIT)


def test_a_torque_limit_narrows_the_converter_to_whole_units_within_it() -> None:
    servo = started()
    for error, units in ((5000.0, 45), (-5000.0, -45), (44.0, 44), (-45.0, -45)):
        servo.update(error, 0, (256, 0, 0, 0, 0), 0.0, NM_PER_VOLT, 0.1)
        assert servo.output_units == units  # 0.1 N m are 45.5 units
    # The sum stands still at the narrower limit too: 44 is within it, 88 is not.
    servo.reset(0.0, 0)
    for _ in range(100):
        servo.update(44.0, 0, (0, 256, 0, 0, 0), 0.0, NM_PER_VOLT, 0.1)
    servo.update(-1.0, 0, (0, 256, 0, 0, 0), 0.0, NM_PER_VOLT, 0.1)
    assert servo.output_units == 43


def test_the_sum_does_not_wind_up() -> None:
    servo = started()
    gains = (256, 256, 0, 0, 0)
    for _ in range(10_000):
        servo.update(1000.0, 0, gains, 0.0, NM_PER_VOLT)
        assert servo.output_units in (2000, OUTPUT_MAXIMUM)
    # 1000 + 1000 = 2000 was within; the second sum would not have been: the sum stopped at 1000, and comes off at once.
    servo.update(0.0, 1, gains, 0.0, NM_PER_VOLT)
    assert servo.output_units == -1 + 999


def test_the_sum_runs_back_while_the_output_is_saturated() -> None:
    servo = started()
    for _ in range(8):
        servo.update(250.0, 0, (0, 256, 0, 0, 0), 0.0, NM_PER_VOLT)
    # Sum 2000. A raised gain saturates it; errors of the other sign still take it down.
    for _ in range(3):
        servo.update(-500.0, 0, (0, 1024, 0, 0, 0), 0.0, NM_PER_VOLT)
    servo.update(0.0, 0, (0, 256, 0, 0, 0), 0.0, NM_PER_VOLT)
    assert servo.output_units == 500


def test_reset_is_bumpless() -> None:
    servo = ServoLoop()
    for sample in range(50):
        servo.update(sample * 40.0, 0, (256, 256, 256, 256, 256), 0.0, NM_PER_VOLT)
    servo.reset(70_000.0, 70_000)
    assert servo.update(70_000.0, 70_000, (256, 256, 256, 256, 256), 0.0, NM_PER_VOLT) == 0.0


def test_demand_resolution() -> None:
    # Demand 0.4 a sample: rounded 0, 0, 1, 1, 2, 2; K_F of 100 units a count.
    expected = {
        DemandResolution.COUNTS: [0, 100, 0, 100, 0],
        DemandResolution.UNROUNDED_DIFFERENCE: [40, 40, 40, 40, 40],
        DemandResolution.UNROUNDED: [40, 40, 40, 40, 40],
    }
    errors = {
        DemandResolution.COUNTS: [0.0, 1.0, 1.0, 2.0, 2.0],
        DemandResolution.UNROUNDED_DIFFERENCE: [0.0, 1.0, 1.0, 2.0, 2.0],
        DemandResolution.UNROUNDED: [0.4, 0.8, 1.2000000000000002, 1.6, 2.0],
    }
    for resolution in DemandResolution:
        servo = started(0.0, 0, resolution)
        outputs: list[int] = []
        seen: list[float] = []
        for sample in range(1, 6):
            servo.update(0.4 * sample, 0, (0, 0, 0, 0, 25_600), 0.0, NM_PER_VOLT)
            outputs.append(servo.output_units)
            seen.append(servo.error_counts)
        assert outputs == expected[resolution]
        assert seen == errors[resolution]


@given(
    st.lists(st.tuples(st.floats(-1e6, 1e6), st.integers(-1_000_000, 1_000_000)), min_size=1, max_size=20),
    st.tuples(*(st.integers(-(2**31), 2**31 - 1),) * 5),
    st.floats(-100.0, 100.0),
    st.sampled_from(DemandResolution),
)
def test_output_is_always_a_whole_unit_within_the_converter(
    samples: list[tuple[float, int]],
    gains: tuple[int, int, int, int, int],
    offset: float,
    resolution: DemandResolution,
) -> None:
    servo = started(0.0, 0, resolution)
    for demand, actual in samples:
        torque = servo.update(demand, actual, gains, offset, NM_PER_VOLT)
        assert isinstance(servo.output_units, int)
        assert OUTPUT_MINIMUM <= servo.output_units <= OUTPUT_MAXIMUM
        assert torque == servo.output_units * VOLT_PER_UNIT * NM_PER_VOLT


def test_a_changed_gain_acts_from_the_next_sample_on() -> None:
    # Demand 7 a sample, actual 5 a sample: the error grows by 2 a sample, and every other difference is constant.
    def sample(servo: ServoLoop, n: int, gains: tuple[int, int, int, int, int]) -> int:
        servo.update(7.0 * n, 5 * n, gains, 0.0, NM_PER_VOLT)
        return servo.output_units

    # In motion: e = 2, 4, 6, 8; sum 2, 6, 12, 20.
    servo = started()
    gains = (256, 0, 0, 512, 512)
    assert [sample(servo, n, gains) for n in (1, 2)] == [2 - 10 + 14, 4 - 10 + 14]
    # K_V and K_F together: no bump where the velocity is followed, 2 counts a sample of difference where it is not.
    assert sample(servo, 3, (256, 0, 0, 1024, 1024)) == 6 + 4 * (7 - 5)
    # K_P doubled doubles its share at once.
    assert sample(servo, 4, (512, 0, 0, 1024, 1024)) == 16 + 4 * (7 - 5)


def test_the_sum_is_kept_in_counts_so_that_a_changed_integral_gain_changes_its_share_at_once() -> None:
    servo = started()
    for _ in range(10):
        servo.update(3.0, 0, (0, 256, 0, 0, 0), 0.0, NM_PER_VOLT)
    assert servo.output_units == 30
    # The eleventh error makes the sum 33, of which twice as much comes out; with K_I at 0 nothing, and the sum waits.
    servo.update(3.0, 0, (0, 512, 0, 0, 0), 0.0, NM_PER_VOLT)
    assert servo.output_units == 66
    servo.update(0.0, 0, (0, 0, 0, 0, 0), 0.0, NM_PER_VOLT)
    assert servo.output_units == 0
    servo.update(0.0, 0, (0, 256, 0, 0, 0), 0.0, NM_PER_VOLT)
    assert servo.output_units == 33


def test_the_sum_comes_off_its_limit_at_once_when_the_error_turns() -> None:
    # K_P 4, K_I 1 units a count: 300 counts give 1200 + sum 300 = 1500, the next 1200 + 600 = 1800, then 1200 + 900 =
    # 2100, past 2047: the sum stays 600. An error of -100 gives -400 + 500 = 100 in the very next sample; had the sum
    # gone on for 100 samples to 30 600, the output would have stood at its limit for 300 samples more.
    servo = started()
    gains = (1024, 256, 0, 0, 0)
    outputs: list[int] = []
    for _ in range(102):
        servo.update(300.0, 0, gains, 0.0, NM_PER_VOLT)
        outputs.append(servo.output_units)
    assert outputs[:3] == [1500, 1800, 2047]
    assert outputs[-1] == 2047
    servo.update(-100.0, 0, gains, 0.0, NM_PER_VOLT)
    assert servo.output_units == 100
