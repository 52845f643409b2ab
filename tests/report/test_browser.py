"""The page in a real browser: first screen, zoom, cursor, tables, requests, errors, accessibility.

Skipped where Playwright or a browser of the Chromium family is not installed.
"""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.cli.browser import find_chromium
from balance_cli.report.page import build_page
from balance_cli.report.sources import group_sources
from tests.support.report_content import artefact, campaign, loads

playwright = pytest.importorskip("playwright.sync_api")
pytestmark = pytest.mark.skipif(find_chromium() is None, reason="no Chromium")

FIRST_PLOT = "#picture-azimuth .axes"


def recorded_run():
    time = np.arange(4096) / 512.0
    samples = np.stack([np.sin(110.0 * time), 1e-7 * np.cos(440.0 * time), np.zeros(len(time))], axis=1)
    pulses = np.arange(0.0, time[-1], 1.0 / 17.5)
    source = MemorySource(samples, None)
    return Run("wind-1", "r", "wind", ("a", "small", "dead"), len(time), source, False, 512.0, 17.5, pulse_times=pulses)


@pytest.fixture(scope="module")
def page_file(tmp_path_factory):
    many = {f"w{i:02}": replace(loads().runs["wind-1"], run=f"w{i:02}") for i in range(9)}
    updated = artefact("balance-loads/1", loads("physical model (ml) with time-delay", 0.01), "8" * 64)
    path = tmp_path_factory.mktemp("page") / "page.html"
    # The calibration has no charts, and its pictures take most of the time.
    shown = [item for item in campaign() if item[1].format != "balance-calibration/1"]
    path.write_text(build_page(group_sources([*shown, (Path("u.h5"), updated)], [recorded_run()])).html, "utf-8")
    content = replace(loads(), runs=many)
    table = build_page(group_sources([(Path("l.h5"), artefact("balance-loads/1", content, "7" * 64))])).html
    path.with_name("many.html").write_text(table, "utf-8")
    return path


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=find_chromium(), args=["--no-sandbox"])
        yield started
        started.close()


@pytest.fixture
def open_page(browser, page_file):
    """Open the page at a width; afterwards nothing was requested and nothing was said on the console.

    Without its security policy, so that a request would be seen, and conditions can be evaluated.
    """
    contexts, requests, messages = [], [], []

    def visit(width=1280, height=800, file=page_file, hash="", **options):
        context = browser.new_context(viewport={"width": width, "height": height}, bypass_csp=True, **options)
        contexts.append(context)
        tab = context.new_page()
        tab.on("request", lambda request: requests.append(request.url))
        tab.on("console", lambda message: messages.append(message.text))
        tab.on("pageerror", lambda error: messages.append(str(error)))
        tab.goto(file.as_uri() + hash)
        return tab

    yield visit
    for context in contexts:
        context.close()
    assert [url for url in requests if not url.startswith(("file:", "blob:", "data:"))] == []
    assert len([url for url in requests if url.startswith("file:")]) == len(contexts)
    assert messages == []


def axis_of(tab, scale="x"):
    return tab.evaluate(
        "s => { const c = balanceCharts.find(c => c.figure.id === 'picture-azimuth').views[0].scales[s];"
        " return [c.min, c.max]; }",
        scale,
    )


def test_the_first_screen_holds_the_loads_and_the_sentence(open_page):
    tab = open_page()
    card = tab.locator(".card").first
    box = card.bounding_box()
    assert box["y"] + box["height"] < 800
    words = card.inner_text()
    for expected in ("Use with care because", "Fx", "Mz", "10.000", "± 0.020", "no zero"):
        assert expected in words
    assert tab.locator("section").first.locator("h2").inner_text() == "Hub loads"


@pytest.mark.parametrize("width", [1280, 390])
def test_nothing_is_cut_off(open_page, width):
    tab = open_page(width, 844)
    tab.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    cut = tab.evaluate(
        "() => [...document.querySelectorAll('table')].filter(t => { const b = t.parentElement;"
        " return b.scrollWidth > b.clientWidth + 1 && getComputedStyle(b).overflowX !== 'auto'; }).length"
    )
    assert cut == 0
    assert tab.evaluate("[...document.querySelectorAll('.card table')].every(t => t.offsetWidth <= innerWidth)")


def test_a_drag_zooms_the_axis_and_linked_charts_and_a_button_shows_all(open_page):
    tab = open_page()
    tab.locator("#picture-azimuth").scroll_into_view_if_needed()
    tab.wait_for_function("window.balanceCharts.some(c => c.figure.id === 'picture-azimuth')")
    assert axis_of(tab) == [0, 360]
    box = tab.locator(f"{FIRST_PLOT} .u-over").first.bounding_box()
    middle = box["y"] + box["height"] / 2
    tab.mouse.move(box["x"] + box["width"] * 0.25, middle)
    tab.mouse.down()
    tab.mouse.move(box["x"] + box["width"] * 0.5, middle + 2, steps=4)
    tab.mouse.up()
    low, high = axis_of(tab)
    assert low == pytest.approx(90.0, abs=3.0) and high == pytest.approx(180.0, abs=3.0)
    views = "balanceCharts.filter(c => c.link === 'azimuth').flatMap(c => c.views)"
    zoomed = tab.evaluate(f"{views}.map(v => v.scales.x.min)")
    assert len(zoomed) > 6 and max(zoomed) - min(zoomed) < 1e-9
    tab.locator("#picture-azimuth [data-act=all]").click()
    assert axis_of(tab) == [0, 360]


def test_the_cursor_reads_the_value_of_the_table(open_page):
    tab = open_page()
    plot = tab.locator(FIRST_PLOT).first
    tab.locator("#picture-azimuth").scroll_into_view_if_needed()
    tab.wait_for_function("window.balanceCharts.some(c => c.figure.id === 'picture-azimuth')")
    tab.evaluate(
        "() => { const u = balanceCharts.find(c => c.figure.id === 'picture-azimuth').views[0];"
        " u.setCursor({left: u.valToPos(120, 'x'), top: 40}); }"
    )
    tab.wait_for_function("!document.querySelector('#picture-azimuth .u-legend .u-value').textContent.includes('–')")
    read = [text.strip() for text in plot.locator(".u-value").all_text_contents()]
    row = tab.locator("#picture-azimuth details.data table").first.locator("tr").nth(7)
    cells = row.locator("td, th").all_text_contents()
    assert read[0] == "120 °" and float(cells[0]) == 120.0
    assert float(read[1].removesuffix(" N").replace("−", "-")) == float(cells[1].replace("−", "-"))


def test_keys_read_values_for_a_screen_reader_and_a_legend_hides_its_curve(open_page):
    tab = open_page()
    plot = tab.locator(FIRST_PLOT).first
    tab.locator("#picture-azimuth").scroll_into_view_if_needed()
    tab.wait_for_selector(f"{FIRST_PLOT} .u-legend")
    plot.focus()
    for _ in range(3):
        tab.keyboard.press("ArrowRight")
    tab.wait_for_function("document.querySelector('#picture-azimuth .live').textContent.includes('azimuth')")
    tab.keyboard.press("+")
    low, high = axis_of(tab)
    assert high - low == pytest.approx(180.0)
    name = plot.locator(".u-legend .u-series th").nth(1)
    assert name.get_attribute("aria-pressed") == "true"
    name.focus()
    tab.keyboard.press("Enter")
    tab.wait_for_selector("#picture-azimuth .u-legend th[aria-pressed=false]")
    assert "u-off" in plot.locator(".u-legend .u-series").nth(1).get_attribute("class")


def test_every_chart_is_drawn(open_page):
    tab = open_page()
    for figure in tab.locator("figure.chart").all():
        figure.scroll_into_view_if_needed()
    tab.wait_for_function("balanceCharts.length === document.querySelectorAll('figure.chart').length", timeout=9000)
    assert tab.evaluate("balanceCharts.flatMap(c => c.views).every(v => v.scales.y.max > v.scales.y.min)")


def test_a_table_of_many_runs_sorts_and_filters(open_page, page_file):
    tab = open_page(file=page_file.with_name("many.html"))
    table = tab.locator("table.sortable")
    first = table.locator("thead button").first
    assert table.locator("tbody td svg").count() == 9
    first.click()
    first.click()
    assert table.locator("tbody tr th").first.inner_text() == "w08"
    tab.locator(".filter input").fill("w03")
    assert table.locator("tbody tr:visible").count() == 1
    assert "1 of 1 rows" in tab.locator(".filter").inner_text()


def test_a_click_on_a_run_shows_its_loads_and_the_address_leads_back(open_page, page_file):
    many = page_file.with_name("many.html")
    tab = open_page(file=many)
    tab.locator("#all-runs tbody tr[data-run='4'] button").click()
    panel = tab.locator(".run-panel")
    assert panel.locator("h3").inner_text() == "w04" and tab.url.endswith("#run=w04")
    cells = [cell.replace("\n", " ") for cell in panel.locator("tbody tr").nth(1).locator("td").all_inner_texts()]
    # Fx at 1/rev is 10 / 2 exp(0.5j).
    assert cells[0].startswith("5.000 ± 0.020 28.6°")
    assert "no zero" in panel.locator("tbody tr").nth(0).inner_text()
    assert panel.locator(".axes").count() == 6
    mean = tab.evaluate("balanceCharts.at(-1).views[2].data[1].slice(0, -1).reduce((a, b) => a + b) / 180")
    assert mean == pytest.approx(12.0, rel=1e-5)
    again = open_page(file=many, hash="#run=w07")
    assert again.locator(".run-panel h3").inner_text() == "w07"


def test_without_scripts_and_in_print_static_pictures_stand_in(open_page):
    tab = open_page(java_script_enabled=False)
    assert tab.locator("#picture-azimuth .static svg").first.is_visible()
    assert not tab.locator("#picture-azimuth .scripted").is_visible()
    printed = open_page(703)  # A4 without its margins
    printed.emulate_media(media="print")
    right = "e => e.getBoundingClientRect().right"
    for card in printed.locator(".card").all():
        assert card.locator("table").evaluate(right) <= card.evaluate(right)
    assert printed.locator("#picture-azimuth .static svg").first.is_visible()
    assert not printed.locator("#picture-azimuth .tools").is_visible()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_contrast_and_labels_pass_axe(open_page, page_file, scheme):
    if find_spec("axe_playwright_python") is None:
        pytest.skip("axe-core is not installed")
    from axe_playwright_python.sync_playwright import Axe

    tab = open_page(color_scheme=scheme, file=page_file.with_name("many.html"))
    tab.locator("#all-runs tbody button").first.click()
    tab.locator("#picture-azimuth").scroll_into_view_if_needed()
    tab.wait_for_selector("#picture-azimuth .u-legend")
    tab.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    found = Axe().run(tab, options={"runOnly": {"type": "tag", "values": ["wcag2a", "wcag2aa"]}}).response["violations"]
    assert {item["id"]: [node["html"][:200] for node in item["nodes"][:3]] for item in found} == {}
