"""What is refused before any bus is opened, and where a run ends."""

import math

import pytest
import yaml
from turning_machine import turning_config

from config.loading import load_config, parse_config
from gateway.errors import GatewayError
from gateway.running.preparation import plan, prepare

PAPER = load_config("paper")


def changed(axes=None, **sections):
    document = yaml.safe_load(PAPER.text)
    for name, values in sections.items():
        document[name].update(values)
    for name, values in (axes or {}).items():
        document["axes"][name].update(values)
    return parse_config(yaml.safe_dump(document), PAPER.path)


@pytest.mark.parametrize("home_deg", [0.0, 90.0, -30.0, 400.0])
@pytest.mark.parametrize("cycles", [1, 7])
def test_a_run_ends_at_the_angle_where_it_began_after_whole_revolutions(home_deg, cycles):
    """Homing on the current position takes the place where a run ended for home."""
    run = plan(changed(axes={"cv": {"home_angle_deg": home_deg}}), cycles)
    start = run.at(0.0)[0]
    assert math.degrees(start) == pytest.approx(home_deg)
    turned = (run.end_position - start) / math.tau
    # Up and down take 7.836 rad together: 2 pi (60 rpm) times 1.2472 s, the time of one ramp.
    assert turned == pytest.approx(cycles + 2, abs=1e-9)
    assert run.at(run.duration_s - 1e-4)[0] == pytest.approx(run.end_position, abs=1e-6)


def test_a_home_position_off_the_cam_is_refused():
    with pytest.raises(GatewayError) as refusal:
        prepare(changed(axes={"servo": {"home_angle_deg": 5.0}}))
    assert "axes.servo.home_angle_deg: 5 is 57 counts from the cam" in str(refusal.value)
    # A slave that keeps the drive's own zero may stand anywhere: this is for the session to see.
    assert prepare(changed(axes={"servo": {"home_angle_deg": 5.0, "homing_method": None}})).violations == ()


def test_the_servos_jerk_is_limited_while_the_master_ramps_too():
    """12175 rad/s^3 at constant speed, 12308 with the terms of a ramp."""
    limits = {**yaml.safe_load(PAPER.text)["axes"]["servo"]["limits"], "jerk_rad_per_s3": 12250.0}
    with pytest.raises(GatewayError) as refusal:
        prepare(changed(axes={"servo": {"limits": limits}}))
    assert len(str(refusal.value).splitlines()) == 1
    assert "jerk while the master ramps at 6 rad/s^2" in str(refusal.value)


@pytest.mark.parametrize(("window", "is_refused"), [(2, True), (60, False)])
def test_a_window_that_fits_nowhere_is_refused(window, is_refused, tmp_path):
    """On a cam without a dwell: a slave that turns on has to be stopped within it."""
    config = turning_config(tmp_path, (("cam_points: 1024", f"cam_points: 1024\n  engagement_window_deg: {window}"),))
    violations = [str(violation) for violation in prepare(config, is_strict=False).violations]
    assert bool(violations) is is_refused
    if is_refused:
        [sentence] = violations
        assert sentence.startswith(
            "motion.engagement_window_deg: within 2 deg the slave can leave its cam nowhere at 45 rpm, "
        )
        assert sentence.endswith(" deg would somewhere")
