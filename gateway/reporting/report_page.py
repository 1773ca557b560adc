"""The frame of the report's page: HTML and CSS, for light and dark alike, without anything from elsewhere."""

from typing import Final

STYLE: Final = """
:root {
  color-scheme: light dark;
  --font: system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", sans-serif;
  --paper: #ffffff; --page: #f5f7f9; --ink: #1c2430; --muted: #5b6675; --grid: #dfe4ea;
  --cv: #0b7a75; --servo: #c2500a; --path: #4053c8; --bad: #c21f3a; --bad-wash: #fdecef;
}
@media (prefers-color-scheme: dark) {
  :root {
    --paper: #171c23; --page: #0f1318; --ink: #e8ecf1; --muted: #9aa6b5; --grid: #2b333e;
    --cv: #3fc6bd; --servo: #ff9a55; --path: #8f9dff; --bad: #ff6b81; --bad-wash: #3a1820;
  }
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink); font: 15px/1.5 var(--font); }
main { max-width: 1040px; margin: 0 auto; padding: 2rem 1.25rem 4rem; }
h1 { margin: 0; font-size: 1.7rem; letter-spacing: -0.01em; }
header p { margin: .2rem 0 1.4rem; color: var(--muted); }
h2 { margin: 2.4rem 0 .7rem; font-size: 1.12rem; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(195px, 1fr)); gap: .8rem; }
.tile { background: var(--paper); border: 1px solid var(--grid); border-radius: 10px; padding: .8rem 1rem; }
.tile span, .tile small { display: block; color: var(--muted); font-size: .82rem; }
.tile strong { display: block; font-size: 1.5rem; font-weight: 650; font-variant-numeric: tabular-nums; }
.tile.bad { background: var(--bad-wash); border-color: var(--bad); }
.tile.bad strong { color: var(--bad); }
figure, .scroll, details {
  margin: 0 0 1rem; background: var(--paper); border: 1px solid var(--grid); border-radius: 10px;
}
figure { padding: 1rem 1rem .8rem; }
figure svg { display: block; width: 100%; height: auto; }
figcaption { margin-top: .5rem; color: var(--muted); font-size: .87rem; }
figcaption b { color: var(--ink); font-weight: 600; }
.scroll { overflow-x: auto; padding: .35rem 1rem; }
table { width: 100%; border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .87rem; }
table.narrow { width: auto; }
th, td { padding: .36rem .5rem; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--grid); }
tbody tr:last-child > * { border-bottom: 0; }
thead th { color: var(--muted); font-weight: 600; }
th:first-child { padding-left: 0; text-align: left; font-weight: 500; }
.unit { color: var(--muted); text-align: left; }
.left { text-align: left; white-space: normal; }
.paper { color: var(--path); }
td.bad { color: var(--bad); font-weight: 700; }
details { padding: .6rem 1rem; }
summary { cursor: pointer; font-weight: 600; }
pre { overflow-x: auto; font-size: .82rem; line-height: 1.45; }
footer { margin-top: 2rem; color: var(--muted); font-size: .85rem; }
@media print { body { background: #fff; } figure, .scroll { break-inside: avoid; } }
"""

PAGE_HEAD: Final = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'{scripts}">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<main>
"""
"""Beginning of every page: nothing from elsewhere; ``scripts`` is empty, or the source of a script that may run."""

PAGE: Final = (
    PAGE_HEAD
    + """<header><h1>{heading}</h1><p>{subtitle}</p></header>
<section class="tiles">{tiles}</section>
{stopped}
<h2>Axes at constant master speed</h2>
{axes}
{servo}
<h2>End effector</h2>
{path}
<h2>Torque</h2>
{torque}
<h2>The whole run</h2>
{run}
<h2>Cycle</h2>
{timing}
<h2>Events</h2>
{events}
<h2>About this run</h2>
{about}
<details><summary>Configuration</summary><pre>{config}</pre></details>
<footer>Following error = position demand − position actual value, both of the same SYNC. The main figures are of
the steady phase; cycles in which an axis' TPDO was missed are counted and left out of its error figures. Velocities
of one sample are differences of positions one cycle apart, so they come in steps of one count a cycle.</footer>
</main>
</body>
</html>
"""
)
