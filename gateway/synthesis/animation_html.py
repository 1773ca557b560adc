"""The linkage over its cycle as one page that needs nothing from elsewhere: inline SVG, moved by a short script.

The page's policy lets exactly this script run (by its hash) and nothing be fetched.
"""

import base64
import hashlib
import json
from html import escape
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gateway.reporting.report_page import PAGE_HEAD, STYLE
from gateway.synthesis.linkage_motion import LinkageMotion

Float = NDArray[np.floating[Any]]

_STYLE: Final = """
.stage { display: grid; gap: 1rem; grid-template-columns: minmax(0, 1.6fr) minmax(0, 1fr); align-items: start; }
@media (max-width: 760px) { .stage { grid-template-columns: minmax(0, 1fr); } }
.traced { fill: none; stroke: var(--path); stroke-width: 1.8; }
.desired { fill: none; stroke: var(--ink); stroke-width: 1.1; stroke-dasharray: 6 4; }
.link { stroke-width: 5; stroke-linecap: round; }
.p { stroke: var(--cv); } .s { stroke: var(--servo); } .q, .r { stroke: var(--muted); }
.joint { fill: var(--paper); stroke: var(--ink); stroke-width: 1.5; }
.tip { fill: var(--path); }
.ground { fill: var(--muted); opacity: .45; }
.curve { fill: none; stroke: var(--servo); stroke-width: 1.8; }
.second { stroke: var(--cv); }
.axis { stroke: var(--grid); stroke-width: 1; }
.cursor { stroke: var(--ink); stroke-width: 1; }
svg text { fill: var(--muted); font: 12px var(--font); }
[class] { vector-effect: non-scaling-stroke; }
.controls { display: flex; flex-wrap: wrap; gap: .8rem; align-items: center; margin: 0 0 1rem; }
.controls input[type=range] { flex: 1 1 14rem; accent-color: var(--path); }
button, select { font: inherit; color: var(--ink); background: var(--paper); border: 1px solid var(--grid);
  border-radius: 8px; padding: .35rem .9rem; cursor: pointer; }
button:focus-visible, select:focus-visible, input:focus-visible { outline: 2px solid var(--path); }
output { font-variant-numeric: tabular-nums; min-width: 5ch; }
"""

_SCRIPT: Final = """
"use strict";
const byId = id => document.getElementById(id);
const count = data.a.length / 2, still = matchMedia("(prefers-reduced-motion: reduce)").matches;
let phase = 0, playing = !still, last = null;
const at = (list, i) => [list[2 * i], list[2 * i + 1]];
const between = (list, f) => {
  const i = Math.floor(f) % count, j = (i + 1) % count, u = f - Math.floor(f), m = at(list, i), n = at(list, j);
  return [m[0] + u * (n[0] - m[0]), m[1] + u * (n[1] - m[1])];
};
const line = (id, m, n) => {
  const e = byId(id);
  e.setAttribute("x1", m[0]); e.setAttribute("y1", m[1]); e.setAttribute("x2", n[0]); e.setAttribute("y2", n[1]);
};
const dot = (id, m) => { const e = byId(id); e.setAttribute("cx", m[0]); e.setAttribute("cy", m[1]); };
function show() {
  const f = phase * count, i = Math.floor(f) % count;
  const a = between(data.a, f), c = between(data.c, f), d = between(data.d, f);
  line("p", data.cv, a); line("q", a, c); line("r", c, d); line("s", data.servo, d);
  dot("A", a); dot("D", d); dot("C", c);
  for (const e of document.querySelectorAll(".cursor")) {
    e.setAttribute("x1", phase * 360); e.setAttribute("x2", phase * 360);
  }
  byId("theta2").textContent = (phase * 360).toFixed(1) + "\\u00b0";
  for (const [id, list, digits] of [["theta5", data.theta5, 2], ["velocity", data.velocity, 2],
                                    ["torque2", data.torque2, 3], ["torque5", data.torque5, 3]])
    byId(id).textContent = list[i].toFixed(digits);
  byId("place").textContent = data.place[2 * i].toFixed(1) + ", " + data.place[2 * i + 1].toFixed(1);
  byId("slide").value = phase * 360;
}
function label() { byId("play").textContent = playing ? "Pause" : "Play"; }
function frame(now) {
  if (playing) {
    if (last !== null) phase = (phase + (now - last) / 1e3 / data.period * Number(byId("speed").value)) % 1;
    show();
  }
  last = now;
  requestAnimationFrame(frame);
}
byId("play").addEventListener("click", () => { playing = !playing; label(); });
byId("slide").addEventListener("input", e => { playing = false; label(); phase = e.target.value / 360 % 1; show(); });
document.addEventListener("keydown", e => {
  if (e.target.tagName === "SELECT") return;
  if (e.key === " " && e.target.tagName !== "BUTTON") { e.preventDefault(); playing = !playing; label(); }
});
label(); show(); requestAnimationFrame(frame);
"""

_PAGE: Final = (
    PAGE_HEAD
    + """<header><h1>{title}</h1><p>{subtitle}</p></header>
<div class="controls">
<button id="play" type="button">Pause</button>
<input id="slide" type="range" min="0" max="360" step="0.5" value="0" aria-label="theta2 in degrees">
<output id="theta2">0.0°</output>
<label>speed <select id="speed">
<option value="1">as the machine</option><option value="0.5">half</option>
<option value="0.25" selected>a quarter</option><option value="0.1">a tenth</option></select></label>
</div>
<div class="stage">
<figure>{linkage}<figcaption><b>Linkage.</b> Solid: the traced curve; dashed: the desired one.
Link p (CV axis) and link s (servo axis) are coloured as their curves are.</figcaption></figure>
<div>
<div class="scroll"><table><tbody>
<tr><th scope="row">servo angle θ5 (deg)</th><td id="theta5"></td></tr>
<tr><th scope="row">servo velocity (rad/s)</th><td id="velocity"></td></tr>
<tr><th scope="row">end effector (mm)</th><td id="place"></td></tr>
<tr><th scope="row">torque, CV motor (N m)</th><td id="torque2"></td></tr>
<tr><th scope="row">torque, servo motor (N m)</th><td id="torque5"></td></tr>
</tbody></table></div>
{charts}
</div>
</div>
</main>
<script>{script}</script>
</body>
</html>
"""
)


def html_of(motion: LinkageMotion) -> str:
    """The page. It shows the motion between the samples by straight lines, so 180 samples and more look smooth."""
    script = f"const data = {json.dumps(_data(motion), separators=(',', ':'), allow_nan=False)};{_SCRIPT}"
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    rpm = motion.speed_rad_per_s * 60.0 / (2.0 * np.pi)
    bar = motion.five_bar
    lengths = ", ".join(f"{n} {v * 1e3:.1f}" for n, v in (("p", bar.p), ("q", bar.q), ("r", bar.r), ("s", bar.s)))
    return _PAGE.format(
        scripts=f"; script-src 'sha256-{digest}'",
        title=escape(f"{motion.name}, the linkage over its cycle"),
        subtitle=escape(f"{rpm:g} rpm; links {lengths} mm; servo swing {np.degrees(motion.displacement_rad):.2f}°"),
        style=STYLE + _STYLE,
        linkage=_linkage(motion),
        charts=_chart("Servo displacement (deg)", (np.degrees(motion.theta5),))
        + _chart("Torque, CV and servo motor (N m)", (motion.torque[:, 1], motion.torque[:, 0])),
        script=script,
    )


def _numbers(values: Float, digits: int) -> list[float]:
    return np.round(values.ravel(), digits).tolist()


def _drawn(points: Float) -> Float:
    """Metres to the drawing's millimetres, whose y points down."""
    return points * np.array([1e3, -1e3])


def _data(motion: LinkageMotion) -> dict[str, object]:
    return {
        "period": round(2.0 * np.pi / motion.speed_rad_per_s, 6),
        "cv": _numbers(_drawn(np.array(motion.five_bar.cv_pivot)), 3),
        "servo": _numbers(_drawn(np.array(motion.five_bar.servo_pivot)), 3),
        "a": _numbers(_drawn(motion.joint_a), 3),
        "c": _numbers(_drawn(motion.end_effector), 3),
        "d": _numbers(_drawn(motion.joint_d), 3),
        "place": _numbers(motion.end_effector * 1e3, 2),
        "theta5": _numbers(np.degrees(motion.theta5), 3),
        "velocity": _numbers(motion.velocity, 3),
        "torque2": _numbers(motion.torque[:, 0], 4),
        "torque5": _numbers(motion.torque[:, 1], 4),
    }


def _path(points: Float, name: str, is_closed: bool) -> str:
    commands = " ".join(f"{x:.2f},{y:.2f}" for x, y in points)
    return f'<path class="{name}" d="M{commands}{"Z" if is_closed else ""}"/>'


def _linkage(motion: LinkageMotion) -> str:
    left, bottom, right, top = (1e3 * edge for edge in motion.extent())
    size = max(right - left, top - bottom)
    radius = 0.011 * size
    pivots = ""
    for x, y in _drawn(np.array([motion.five_bar.cv_pivot, motion.five_bar.servo_pivot])):
        foot = 2.6 * radius
        pivots += (
            f'<polygon class="ground" points="{x:.2f},{y:.2f} {x - foot:.2f},{y + 1.6 * foot:.2f} '
            f'{x + foot:.2f},{y + 1.6 * foot:.2f}"/><circle class="joint" cx="{x:.2f}" cy="{y:.2f}" r="{radius:.2f}"/>'
        )
    links = "".join(f'<line id="{name}" class="link {name}"/>' for name in "qrps")
    joints = "".join(f'<circle id="{name}" class="joint" r="{radius:.2f}"/>' for name in "AD")
    return (
        f'<svg role="img" aria-label="the linkage" viewBox="{left:.2f} {-top:.2f} {right - left:.2f} '
        f'{top - bottom:.2f}">{_path(_drawn(motion.end_effector), "traced", True)}'
        f"{_path(_drawn(motion.curve.points), 'desired', True)}{links}{pivots}{joints}"
        f'<circle id="C" class="tip" r="{1.2 * radius:.2f}"/></svg>'
    )


def _chart(title: str, series: tuple[Float, ...]) -> str:
    """Curves over theta2, 360 units wide and 120 high, with a cursor that the script moves."""
    low = min(float(values.min()) for values in series)
    high = max(float(values.max()) for values in series)
    if high - low < 1e-9:
        low, high = low - 1.0, high + 1.0
    height = 120.0
    paths = ""
    for values, name in zip(series, ("curve", "curve second"), strict=False):
        closed = np.append(values, values[0])
        theta2 = np.linspace(0.0, 360.0, closed.size)
        # The last point is the first of the next cycle, except on an axis that turns on.
        shown = slice(None, -1) if abs(values[-1] - values[0]) > 0.5 * (high - low) else slice(None)
        paths += _path(np.stack((theta2, height * (high - closed) / (high - low)), axis=1)[shown], name, False)
    zero = height * high / (high - low)
    ground = f'<line class="axis" x1="0" x2="360" y1="{zero:.2f}" y2="{zero:.2f}"/>' if 0.0 <= zero <= height else ""
    return (
        f'<figure><svg role="img" aria-label="{escape(title)}" viewBox="-4 -16 368 150">{ground}{paths}'
        f'<line class="cursor" y1="0" y2="{height:g}"/><text x="0" y="-4">{round(high, 3):g}</text>'
        f'<text x="0" y="{height + 13:g}">{round(low, 3) + 0.0:g}</text><text x="360" '
        f'y="{height + 13:g}" text-anchor="end">'
        f"θ2 = 360°</text></svg><figcaption><b>{escape(title)}</b></figcaption></figure>"
    )
