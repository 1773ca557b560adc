"""A five-bar whose slave turns with its master: a double crank, its pivots nearer to each other than link s is long.

With s (150 mm) longer than p and the pivots' distance together (80 + 40), the line from A to D turns with link s; q and
r, which keep away from being in line, turn with it, and the angle between r and s need not pass zero.
"""

from pathlib import Path

import numpy as np

from config.loading import load_config, parse_config
from config.schema import GatewayConfig
from mechanism.five_bar import Closure, FiveBar

LINKS = FiveBar(0.08, 0.14, 0.12, 0.15, (0.0, 0.0), (0.04, 0.0))
CLOSURE = Closure.RIGHT


def servo_angle(theta2):
    """theta5 (rad) on the cam: one turn in each of the master's, 90 deg ahead, give or take 17 deg."""
    return theta2 + np.pi / 2 + 0.3 * np.sin(theta2)


def turning_config(folder: Path, more: tuple[tuple[str, str], ...] = ()) -> GatewayConfig:
    """Write the curve into ``folder`` and give the configuration; ``more`` are further replacements in its text."""
    theta2 = np.radians(np.arange(360))
    points = LINKS.end_effector(theta2, servo_angle(theta2), CLOSURE) * 1e3
    rows = [f"{degrees},{x:.6f},{y:.6f}" for degrees, (x, y) in enumerate(points.tolist())]
    (folder / "turning.csv").write_text("\n".join(["theta2_deg,x_mm,y_mm", *rows, ""]))
    text = load_config("paper").text
    replaced = (
        ("name: paper", "name: turning"),
        ("p_mm: 150", "p_mm: 80"),
        ("q_mm: 250", "q_mm: 140"),
        ("r_mm: 300", "r_mm: 120"),
        ("servo_pivot_mm: [250, 0]", "servo_pivot_mm: [40, 0]"),
        ("com_m: 0.09072986577181207", "com_m: 0.05"),
        ("com_m: 0.125", "com_m: 0.07"),
        ("com_m: 0.15,", "com_m: 0.06,"),
        ("curve: desired_path.csv", "curve: turning.csv"),
        ("speed_rpm: 60", "speed_rpm: 45"),
        ("      position_deg: [-10, 110]\n", ""),
        *more,
    )
    for old, new in replaced:
        assert old in text, old
        text = text.replace(old, new)
    head, servo = text.split("  servo:\n")
    return parse_config(
        head + "  servo:\n" + servo.replace("home_angle_deg: 0.0", "home_angle_deg: 90.0", 1), folder / "turning.yaml"
    )
