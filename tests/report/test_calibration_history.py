"""Control chart of calibrations on the page: no alarm without a change; drifts and steps named and dated."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from balance_cli.calibration.control_chart import control_chart, running_control_charts
from balance_cli.report.blocks import Chart, Table, WarningText
from balance_cli.report.calibration_history import section
from balance_cli.report.page import build_page
from balance_cli.report.sources import group_sources
from tests.calibration.test_control_chart import calibrated
from tests.report.test_math_model import given
from tests.support.report_content import artefact


def history(gains, first_seed=0):
    return section(given(*(calibrated(first_seed + i, gain) for i, gain in enumerate(gains))))


def sentence(made):
    return made.blocks[0].text


def test_an_unchanged_balance_is_in_control():
    """Eight pages: one in 100 may say that it is not, and one in 40 has a coefficient beyond its limits."""
    verdicts = [sentence(history([1.0] * 5, 10 * i)).split(":")[0] for i in range(8)]
    assert verdicts.count("In control") >= 7


def test_a_drift_is_named_with_channel_term_size_and_date():
    """A gain that drifts by half a per mille a calibration, which has an error of one per mille."""
    made = history([1.0 + 5e-4 * i for i in range(7)])
    assert isinstance(made.blocks[0], WarningText)
    assert sentence(made).startswith("Not in control: ")
    assert "B0 N1 drifts by +0.0" in sentence(made) and "since c5.h5" in sentence(made)
    table = next(block for block in made.blocks if isinstance(block, Table))
    assert [cell.text for cell in table.rows[0]][:2] == ["B0", "N1"] and table.rows[0][-1].text == "c5.h5"
    assert {row[0].text for row in table.rows if row[-1].text != "none"} == {"B0"}


def test_a_step_that_lasts_is_no_drift_but_dated():
    """The newest is within the limits, which the step has widened, and the line is no better than the step."""
    made = history([1.0, 1.0, 1.0, 1.0, 1.02, 1.02, 1.02])
    assert "B0 N1" in sentence(made) and "since c4.h5" in sentence(made)


def test_the_picture_has_values_and_limits_of_every_calibration():
    """Values are those of the control chart of the command line; limits are those that each calibration had to meet."""
    gains = [1.0, 1.0, 1.0, 1.0, 1.02]
    named = [(f"c{i}.h5", calibrated(i, gain)) for i, gain in enumerate(gains)]
    charts = running_control_charts(named)
    whole = control_chart(named)
    np.testing.assert_array_equal(charts[-1].coefficients[0].values, whole.coefficients[0].values)
    earlier = control_chart(named[:4])
    own, before = ({each.key: each for each in chart.coefficients} for chart in (charts[1], earlier))
    assert own["B0", "N1"].low == before["B0", "N1"].low and own.keys() == before.keys()
    chart = next(block for block in history(gains).blocks if isinstance(block, Chart))
    plot = chart.groups[0].plots[0]
    values, low, high = (
        next(t.y for t in plot.traces if t.label == n) for n in ("value", "lower limit", "upper limit")
    )
    assert plot.title == "B0 N1" and np.isnan(high[:2]).all() and np.isfinite(high[2:]).all()
    assert np.all((low < values)[2:4] & (values < high)[2:4]) and values[4] > high[4]


def test_two_calibrations_have_no_section_and_other_balances_no_chart():
    made = [calibrated(i) for i in range(3)]
    assert section(given(*made[:2])) is None
    model = replace(made[0].all_trims.model, components=("a", "b", "c"))
    strange = replace(made[0], all_trims=replace(made[0].all_trims, model=model))
    assert "No control chart of these calibrations" in sentence(section(given(strange, *made[1:])))


def test_the_page_has_the_section_and_calibrations_in_the_order_given():
    """The name of the oldest file is the last of the alphabet; the chart of one that is given twice counts it once."""
    made = [calibrated(i) for i in range(3)]
    items = [
        (Path(name), artefact("balance-calibration/1", one, digest * 64))
        for name, one, digest in zip(["z.h5", "b.h5", "a.h5", "y.h5"], [*made, made[0]], "1231", strict=True)
    ]
    html = build_page(group_sources(items)).html
    assert "z.h5 to a.h5" in html and 'id="calibration-history"' in html and "over 3 calibrations" in html
