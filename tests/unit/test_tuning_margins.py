"""Margins against textbook loops, the eigenvalues of the closed loop, and a measured response."""

import math

import numpy as np
import pytest

from config.loading import load_config, parse_config
from gateway.running.preparation import compile_config
from gateway.tuning import controller
from gateway.tuning.margins import (
    Margin,
    Margins,
    Robustness,
    delay_margin_s,
    gain_array,
    is_stable,
    loop_model,
    loop_transfer,
    margins_of,
    model_at,
    raised,
    robustness,
    spectral_radius,
)
from gateway.tuning.response import FINE_COUNTS, frictionless_text, measure_loop
from sim_drive.closed_loop import closed_loop_of
from sim_drive.physics import servo

PAPER = load_config("paper")
GAINS = np.array([[8000, 0, 0, 120_000, 120_000], [4000, 40, 500, 45_000, 45_000]], dtype=float)
HZ = np.geomspace(0.01, 10.0, 4000)
S = 2j * np.pi * HZ
ZERO = np.zeros(1)


def changed(*replacements):
    text = PAPER.text
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new)
    return parse_config(text, PAPER.path)


@pytest.fixture(scope="module")
def model():
    cam = compile_config(PAPER)
    return loop_model(PAPER, cam.profile, cam.closure, positions=36, frequencies=300)


def diagonal(first, second):
    loop = np.zeros((1, len(HZ), 2, 2), dtype=complex)
    loop[0, :, 0, 0], loop[0, :, 1, 1] = first, second
    return loop


def test_margins_of_a_textbook_loop():
    # 2 / (s (s + 1) (s + 2)): phase -180 deg at sqrt(2) rad/s, where the gain is 2/6.
    loop = 2.0 / (S * (S + 1.0) * (S + 2.0))
    margins = margins_of(diagonal(loop, 0.01 / (S + 1.0)), HZ, ZERO)
    assert margins.gain_dB.value == pytest.approx(20 * math.log10(3.0), abs=0.01)
    assert margins.gain_dB.frequency_hz == pytest.approx(math.sqrt(2.0) / math.tau, rel=0.01)
    # |L| = 1 at w: w^2 (w^2 + 1) (w^2 + 4) = 4, w = 0.7494; phase margin 90 - atan(w) - atan(w / 2) = 32.6 deg.
    assert margins.phase_deg.value == pytest.approx(32.6, abs=0.1)
    assert margins.sensitivity_peak.value == pytest.approx(np.abs(1.0 / (1.0 + loop)).max(), rel=1e-9)


def test_coupling_is_in_the_margins():
    # Raised together the coupled loop has the eigenvalues 1.5 g and 0.5 g.
    g = 0.5 / (S * (S + 1.0) * (S + 2.0))
    loop = diagonal(g, g)
    alone = margins_of(loop, HZ, ZERO).gain_dB.value
    loop[0, :, 0, 1] = loop[0, :, 1, 0] = 0.5 * g
    together = margins_of(loop, HZ, ZERO).gain_dB.value
    assert alone == pytest.approx(20 * math.log10(12.0), abs=0.01)
    assert together == pytest.approx(20 * math.log10(8.0), abs=0.01)


@pytest.mark.parametrize("factors", [(1, 0), (0, 1), (1, 1)])
def test_raising_the_gains_by_the_margin_brings_the_loop_to_its_bound(model, factors):
    """The least of the three gain margins is where the eigenvalues of the whole loop reach the unit circle."""
    margin = margins_of(loop_transfer(model, GAINS), model.frequencies_hz, model.theta2).gain_dB.value
    below, above = (10.0 ** ((margin + decibel) / 20.0) for decibel in (-0.25, 0.25))
    assert is_stable(model, raised(GAINS, [below if factor else 1.0 for factor in factors]))
    if factors == (1, 1):
        results = [
            is_stable(model, raised(GAINS, [above if one else 1.0, above if other else 1.0]))
            for one, other in ((1, 0), (0, 1), (1, 1))
        ]
        assert not all(results)


def test_the_delay_margin_is_where_stability_ends(model):
    margin_s = delay_margin_s(model, GAINS)
    assert 0.002 < margin_s < 0.01
    assert is_stable(model, GAINS, 0.98 * margin_s)
    assert not is_stable(model, GAINS, 1.02 * margin_s)
    assert spectral_radius(model, GAINS, 0.0).max() < spectral_radius(model, GAINS, margin_s).max()


def test_an_output_delay_is_a_delay(model):
    cam = compile_config(PAPER)
    prompt = changed(("output_delay_periods: 1", "output_delay_periods: 0"))
    prompt_model = loop_model(prompt, cam.profile, cam.closure, positions=36, frequencies=300)
    assert spectral_radius(model, GAINS) == pytest.approx(spectral_radius(prompt_model, GAINS, 1 / 1024), rel=1e-9)
    assert delay_margin_s(model, GAINS) == pytest.approx(delay_margin_s(prompt_model, GAINS) - 1 / 1024, abs=1e-6)


def test_problems_are_told_each_in_a_sentence(model):
    def stated(gain_dB, delay_s):
        somewhere = Margin(1.5, 0.0, 1.0)
        return Robustness(True, Margins(Margin(gain_dB, 190.0, 60.0), somewhere, somewhere), delay_s).problems()

    assert stated(9.0, 0.003) == []
    assert stated(7.04, 0.001) == [
        "the gain margin is 7.0 dB at theta2 = 190 deg (bound 8 dB)",
        "the loop becomes unstable with 1.00 ms of additional delay (bound 2 ms)",
    ]
    wild = robustness(model, raised(GAINS, (20.0, 20.0)))
    assert wild.problems() == ["the gains make the loop unstable"]
    assert wild.to_json()["gain_margin_dB"] is None


def test_the_controller_is_the_drives():
    assert (controller.SERVO_RATE_HZ, controller.GAIN_SCALE) == (servo.SERVO_RATE_HZ, servo.GAIN_SCALE)
    assert servo.VOLT_PER_UNIT == controller.VOLT_PER_UNIT
    # Its response is that of the drive's own code to a sine of many counts.
    gains, hz, count = (900, 30, 40_000, 20_000, 7), 16, 4096
    loop = servo.ServoLoop()
    positions = [round(100_000 * math.sin(math.tau * hz * k / 1024)) for k in range(count)]
    loop.reset(0.0, positions[0])
    small = tuple(gain / 2000 for gain in gains)  # so that nothing is limited
    outputs = [loop.update(0.0, position, small, 0.0, 1.0 / servo.VOLT_PER_UNIT) for position in positions]
    carrier = np.exp(-2j * np.pi * hz * np.arange(count) / 1024)[2048:]
    measured = -(carrier @ outputs[2048:]) / (carrier @ positions[2048:]) * 2000
    assert measured == pytest.approx(controller.controller_response(gains, np.array([float(hz)]))[0], rel=0.02)


def test_gains_out_of_bounds_are_refused():
    with pytest.raises(controller.UsageError, match="K_P is -1, but must be 0 to 1000000"):
        controller.Gains(-1)
    pair = (controller.Gains(1, 2, 3, 4, 5), controller.Gains.of([6.4, 7, 8, 9, 10]))
    assert gain_array(pair).tolist() == [[1, 2, 3, 4, 5], [6, 7, 8, 9, 10]]


@pytest.mark.slow
@pytest.mark.parametrize("theta2_deg", [20.0, 170.0, 340.0])
def test_the_model_agrees_with_the_measured_response(theta2_deg):
    """Sines injected at the outputs of the simulated loop, correlated: I + L within 1.5 % of the model up to 300 Hz.

    With resolvers of 2^20 counts, so that quantisation does not hide the loop, without dry friction, held still.
    """
    fine = FINE_COUNTS
    config = parse_config(frictionless_text(PAPER), PAPER.path)
    cam = compile_config(config)
    theta2 = math.radians(theta2_deg)
    theta = (theta2, cam.profile.at(theta2)[0])
    loop = closed_loop_of(config)
    loop.gains = GAINS * 4096 / fine
    scale = fine / math.tau
    measured = measure_loop(loop, theta, (scale, scale), (1.5, 1.5), frequencies_hz=(2, 5, 14, 30, 60, 90, 130, 300))
    still = np.zeros((1, 2))
    model = model_at(config, np.array([theta]), still, still, cam.closure, hz=measured.frequencies_hz)
    expected = loop_transfer(model, loop.gains)[0]
    returned = np.eye(2) + expected
    distance = np.linalg.norm(measured.transfer - expected, axis=(1, 2)) / np.linalg.norm(returned, axis=(1, 2))
    assert distance.max() < 0.015
