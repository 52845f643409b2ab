"""Charts in a browser: time to the first picture and to a zoom with 10^6 points, this page beside plotly.

Both draw the same curve from the same file-sized data (float32 in base64) in the same headless Chromium. Times are from
the start of the navigation, and from the call of the zoom, to the second animation frame after it.
"""

from __future__ import annotations

import base64
import statistics
import tempfile
from pathlib import Path

import numpy as np

from balance_cli.cli.browser import find_chromium
from balance_cli.report.blocks import Chart, Section
from balance_cli.report.page import render_page
from balance_cli.report.plots import Plot, Trace

POINTS = 1_000_000
REPEATS = 3

LONGEST = 300_000
"""Milliseconds after which a chart is given up."""
AFTER_DRAWING = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(performance.now()))))"
PLOTLY = """<!DOCTYPE html><html><head><meta charset="utf-8"><script>{script}</script></head><body>
<div id="chart" style="width:1100px;height:320px"></div><script>
const raw = atob("{data}"), bytes = Uint8Array.from(raw, c => c.charCodeAt(0)), y = new Float32Array(bytes.buffer);
Plotly.newPlot("chart", [{{y, type: "{kind}", mode: "lines", line: {{width: 1}}}}], {{margin: {{t: 20}}}})
  .then(() => {{ window.drawn = true; }});
</script></body></html>"""


def run() -> str:
    """Return a table of medians."""
    from playwright.sync_api import sync_playwright

    y, lines = curve(), []
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        pages = write_pages(Path(folder), y)
        browser = driver.chromium.launch(executable_path=find_chromium(), args=["--no-sandbox"])
        for name, (path, ready, zoom) in pages.items():
            times = [measure(browser, path, ready, zoom) for _ in range(REPEATS)]
            first, zoomed = (statistics.median(column) for column in zip(*times, strict=True))
            size = path.stat().st_size / 1e6
            lines.append(f"{name:28s} {size:6.1f} MB   first picture {first:7.0f} ms   zoom {zoomed:6.0f} ms")
        browser.close()
    return "\n".join(lines)


def curve() -> np.ndarray:
    """A record with harmonics and noise (n,)."""
    time = np.arange(POINTS) / 5000.0
    noise = np.random.default_rng(0).normal(size=POINTS)
    return np.sin(110.0 * time) + 0.3 * np.sin(440.0 * time) + 0.1 * noise


def write_pages(folder: Path, y: np.ndarray) -> dict[str, tuple[Path, str, str]]:
    """Return {name: (file, condition that the chart is drawn, expression that zooms)}."""
    from importlib.resources import files

    script = files("plotly").joinpath("package_data/plotly.min.js").read_text(encoding="utf-8")
    data = base64.b64encode(y.astype("<f4").tobytes()).decode("ascii")
    pages = {}
    plot = Plot("record", np.arange(POINTS, dtype=float), (Trace("y", y, "#0072b2", width=1.0),), "sample", "y [V]")
    section = Section("chart", "Chart", (Chart.single("chart", "A record", (plot,), wide=True),))
    ours = folder / "ours.html"
    ours.write_text(render_page("Chart", (section,)), encoding="utf-8")
    middle = f"{{min: {POINTS // 2}, max: {POINTS // 2 + POINTS // 10}}}"
    pages["this page (uPlot)"] = (
        ours,
        "window.balanceCharts && balanceCharts.length && balanceCharts[0].views.length",
        f"balanceCharts[0].views[0].setScale('x', {middle})",
    )
    for kind in ("scattergl", "scatter"):
        path = folder / f"{kind}.html"
        path.write_text(PLOTLY.format(script=script, data=data, kind=kind), encoding="utf-8")
        zoom = f"Plotly.relayout('chart', {{'xaxis.range': [{POINTS // 2}, {POINTS // 2 + POINTS // 10}]}})"
        pages[f"plotly {kind}"] = (path, "window.drawn", zoom)
    return pages


def measure(browser, path: Path, ready: str, zoom: str) -> tuple[float, float]:
    """Return the milliseconds to the first picture and of a zoom, in a fresh tab."""
    context = browser.new_context(viewport={"width": 1280, "height": 800}, bypass_csp=True)
    tab = context.new_page()
    tab.goto(path.as_uri(), wait_until="commit", timeout=LONGEST)
    tab.wait_for_function(ready, timeout=LONGEST, polling="raf")
    first = tab.evaluate(AFTER_DRAWING)
    call = f"(async () => {{ const t = performance.now(); await ({zoom}); return await {AFTER_DRAWING} - t; }})()"
    zoomed = tab.evaluate(call)
    context.close()
    return first, zoomed
