"""The calibration model on the page: terms, zeros, outliers, check loads and residuals."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from balance_cli.calibration.term_choice import LINEAR_TERMS
from balance_cli.campaign.recording.run import MemorySource
from balance_cli.campaign.recording.run_file import open_run
from balance_cli.campaign.rig.channel import Channel
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.load_components import FullScale
from balance_cli.report import math_model_figures
from balance_cli.report.blocks import Details, pictures
from balance_cli.report.calibration import section
from balance_cli.report.load_series_rows import (
    channel_outliers,
    channel_ranges,
    channel_residual_sigma,
    split_load_series,
)
from balance_cli.report.math_model_figures import TREND_SIGNIFICANCE, fit_trend, load_figure, order_figure, varied_loads
from balance_cli.report.math_model_tables import LOADS_ONLY, channel_table, check_table, nonlinear_terms, term_table
from balance_cli.report.number_format import format_percent, format_significant, value_and_sigma_text
from balance_cli.report.page import build_page
from balance_cli.report.reading_scale import reading_scale
from balance_cli.report.sources import Sources, group_sources
from balance_cli.steps.calibrate import calibrate
from tests.support.page_content import read, row_of, tables, texts
from tests.support.report_content import artefact, calibration
from tests.support.rigs import one_degree_of_freedom, rotor_balance
from tests.support.static_runs import loading, static_run

SAMPLES = Path(__file__).parents[2] / "sample_data"
FULL_RANGE = np.array([800.0, 800.0, 3725.0, 400.0, 400.0, 450.0])
OUTLIER_ROW, BAD_ROWS = 70, slice(21, 41)


def static(name: str):
    return open_run(SAMPLES / f"static-{name}.h5")


def curved(run, outlier: float = 0.0, gain: float = 1.0):
    """The run with two curved terms; one row of y1 off by `outlier` [V], y2 `gain` times itself while Fy moves."""
    block, at = run.read(), run.channel_names.index
    x, channels = block.loads / FULL_RANGE, block.channels.copy()
    channels[:, at("z1.strain")] += 4e-3 * x[:, 2] ** 2
    channels[:, at("x.strain")] += 4e-3 * np.abs(x[:, 0])
    channels[OUTLIER_ROW, at("y1.strain")] += outlier
    channels[BAD_ROWS, at("y2.strain")] *= gain
    return replace(run, source=MemorySource(channels, block.loads))


def given(*made, **options) -> Sources:
    each = [artefact("balance-calibration/1", one, f"{i}" * 64) for i, one in enumerate(made)]
    named = [replace(one, provenance=replace(one.provenance, options=options)) for one in each]
    return group_sources([(Path(f"c{i}.h5"), one) for i, one in enumerate(named)])


def table_with(made, head: str):
    return next(one for one in tables(made) if head in [cell.text for cell in one.head[0]])


@pytest.fixture(scope="module")
def sound():
    return calibrate(
        [static("bare"), static("trim")], rotor_balance(), hold_out=[replace(static("bare"), name="again")]
    )


@pytest.fixture(scope="module")
def spoiled():
    """Curved terms, an outlier and a sequence that two others contradict."""
    again = replace(curved(static("bare")), name="static-again")
    runs = [curved(static("bare"), outlier=5e-3), curved(static("trim"), gain=1.2), again]
    return calibrate(runs, rotor_balance())


@pytest.fixture(scope="module")
def sound_section(sound):
    return section(given(sound))


@pytest.fixture(scope="module")
def spoiled_section(spoiled):
    return section(given(spoiled))


def test_a_sound_calibration_is_told_in_a_sentence_and_warns_of_nothing(sound_section):
    made = sound_section
    words = texts(made, "text")
    assert "242 rows of static-bare and static-trim in 12 load series, each with its own zero" in words
    assert "any spurious term in the balance 0.01" in words and "no channel has such terms" in words
    assert (
        "flagged as extrapolated, and beyond Fx ±880 N, Fy ±880 N" in words and "Calibrated: Fx −800 to 800 N" in words
    )
    assert "by iteration" not in words
    assert texts(made, "warn") == ""
    assert not any("variance inflation" in [cell.text for cell in one.head[0]] for one in tables(made))


def test_the_non_iterative_method_is_stated_where_it_was_requested(sound_section):
    made = calibrate([static("bare"), static("trim")], rotor_balance(), non_iterative=True)
    words = texts(section(given(made)), "text")
    assert "as functions of the readings" in words
    assert all(
        f"{name} {format_significant(float(value), 2)}" in words
        for name, value in zip(
            made.all_trims.model.components, made.all_trims.non_iterative.residual_percent_fs, strict=True
        )
    )
    assert "Non-iterative" not in texts(sound_section, "text")


def test_the_channels_are_as_the_model_has_them(sound, sound_section):
    all_trims = sound.all_trims
    ranges = channel_ranges(sound, all_trims)
    assert ranges[0] == pytest.approx(10.0) and ranges[-1] == pytest.approx(9.0, rel=1e-3)
    table = table_with(sound_section, "nonlinear terms")
    assert [row[0].text for row in table.rows] == list(all_trims.model.channel_names)
    for c, row in enumerate(table.rows):
        errors = (
            channel_residual_sigma(all_trims)[c],
            all_trims.model.press[c],
            all_trims.model.cross_validation_rms[c],
        )
        assert row[1].text == LOADS_ONLY
        assert [cell.text for cell in row[2:5]] == [format_significant(1e6 * error) for error in errors]
        assert [cell.note for cell in row[2:5]] == [f"{format_percent(error / ranges[c])} %" for error in errors]
        slope, sigma = 1e6 * all_trims.drift.slope[c], 1e6 * all_trims.drift.slope_sigma[c]
        assert row[5].text == " ± ".join(value_and_sigma_text(slope, sigma))
        assert row[5].mark == ("bad" if abs(slope) > 3 * sigma else "")
        assert row[6].text == format_significant(all_trims.drift.chi2_per_dof[c], 2)


def test_a_drift_beyond_three_sigma_and_a_scatter_beyond_chance_are_marked(sound):
    drift = sound.all_trims.drift
    slope, scatter = drift.slope.copy(), drift.chi2_per_dof.copy()
    slope[2], scatter[4] = -3.1 * drift.slope_sigma[2], 3.0
    slope[3], scatter[5] = 2.9 * drift.slope_sigma[3], 2.0
    all_trims = replace(sound.all_trims, drift=replace(drift, slope=slope, chi2_per_dof=scatter))
    table = channel_table(all_trims, np.ones(8))
    assert table.rows[2][5].mark == "bad" and table.rows[3][5].mark == ""
    assert table.rows[4][6].mark == "bad" and table.rows[5][6].mark == ""


def test_check_loads(sound, sound_section):
    (check,) = sound.all_trims.checks
    row = table_with(sound_section, "left out").rows[0]
    assert [cell.text for cell in row[1:7]] == [
        format_percent(e) for e in check.error / sound.all_trims.model.calibrated_range
    ]
    assert [cell.note for cell in row[1:7]] == [f"{100 * share:.0f} %" for share in check.interval_coverage]
    assert [cell.text for cell in (row[0], *row[7:])] == ["again", "121", "0"]
    assert all(cell.mark == "" for cell in row[1:])


def test_check_rows_out_of_reach_and_intervals_that_do_not_hold_are_marked(sound):
    (check,) = sound.all_trims.checks
    solved = check.is_valid.copy()
    solved[:5] = False
    narrow = replace(check, is_valid=solved, prediction_interval=0.5 * check.prediction_interval, run="narrow")
    calibrated = FullScale(sound.all_trims.model.calibrated_range, (False,) * 6)
    nothing = replace(check, is_valid=np.zeros_like(solved), run="nothing")
    rows = check_table(replace(sound.all_trims, checks=(narrow, nothing)), calibrated).rows
    assert [cell.text for cell in rows[0][7:]] == ["121", "5"] and rows[0][8].mark == "bad"
    assert {cell.mark for cell in rows[0][1:7]} == {"bad"}
    assert {cell.text for cell in rows[1][1:7]} == {"–"} and rows[1][8].text == "121"


def test_terms_that_the_loads_do_not_support_are_folded_with_their_reasons(sound, sound_section):
    refused = sound.all_trims.model.unsupported_terms
    folded = next(one for one in sound_section.blocks if isinstance(one, Details) and "support" in one.summary)
    assert folded.summary.startswith(f"{len(refused)} terms")
    (table,) = folded.blocks
    shown = {term: row[0].text for row in table.rows for term in row[1].text.split(", ")}
    assert shown == refused


def test_nonlinear_terms_with_their_evidence(spoiled, spoiled_section):
    model, made = spoiled.all_trims.model, spoiled_section
    c, i = model.channel_names.index("z1.strain"), model.terms.index("Fz^2")
    value, sigma = model.coefficients[i, c], np.sqrt(model.covariance[c, i, i])
    assert value == pytest.approx(4e-3, rel=0.1)
    head = "variance inflation"
    row = row_of(made, head, "z1.strain")
    assert row[1:4] == [
        "Fz^2",
        " ± ".join(value_and_sigma_text(1e6 * value, 1e6 * sigma)),
        format_significant(value / sigma),
    ]
    assert row[5] == format_significant(model.variance_inflation[i, c], 2)
    assert row_of(made, head, "x.strain")[1] == "|Fx|"
    assert row_of(made, head, "torque") == ["torque", LOADS_ONLY]
    assert row_of(made, "nonlinear terms", "z1.strain")[1] == str(len(nonlinear_terms(spoiled.all_trims, c)))
    words = texts(made, "text")
    assert "x.strain and z1.strain have such terms" in words
    rho = model.contraction().rho
    assert f"reduces the error to {format_significant(100 * rho, 2)} % or less" in words


def test_inflated_terms_are_marked(spoiled):
    model = spoiled.all_trims.model
    inflation = model.variance_inflation.copy()
    inflation[model.terms.index("Fz^2"), model.channel_names.index("z1.strain")] = 40.0
    all_trims = replace(spoiled.all_trims, model=replace(model, variance_inflation=inflation))
    rows = term_table(all_trims).rows
    assert [row[1].text for row in rows if row[-1].mark == "bad"] == ["Fz^2"]


def test_excluded_data_are_warned_of(spoiled, spoiled_section):
    (bad,), (outlier,) = spoiled.all_trims.suspect_series, spoiled.all_trims.outliers
    words = texts(spoiled_section, "warn")
    assert (
        f"static-trim rows 22 to 41 (Fy): y2.strain changes {value_and_sigma_text(bad.gain, bad.gain_sigma)[0]} ±"
        in words
    )
    size = format_significant(1e6 * outlier.error)
    assert f"static-bare row {OUTLIER_ROW + 1}: y1.strain is {size} µV above the prediction of all other rows" in words
    assert "342 of 363 rows" in texts(spoiled_section, "text")


def test_swapped_and_ambiguous_load_series_are_named(spoiled):
    bad = replace(
        spoiled.all_trims.suspect_series[0], resembled_channel="z2.strain", alternatives=("s3 rows 1 to 9 (Fx)",)
    )
    shrunk = "Fx: the calibrated range is 150, not 200, because the rows with larger loads were excluded"
    pair = "x.strain and y1.strain"
    all_trims = replace(spoiled.all_trims, suspect_series=(bad,), screening_notes=(shrunk,), swapped_channels=(pair,))
    words = texts(section(given(replace(spoiled, all_trims=all_trims))), "warn")
    assert f"{shrunk}." in words and f"{pair} read each other's loads" in words
    assert ", as expected of z2.strain." in words and "s3 rows 1 to 9 (Fx) may be wrong instead." in words


def test_an_iteration_that_is_not_proved_is_warned_of(spoiled):
    model = spoiled.all_trims.model
    coefficients = model.coefficients.copy()
    coefficients[len(model.components) :] *= 1e4
    all_trims = replace(spoiled.all_trims, model=replace(model, coefficients=coefficients))
    assert not all_trims.model.contraction().is_proved
    made = section(given(replace(spoiled, all_trims=all_trims)))
    assert "not proved to converge" in texts(made, "warn")
    assert "Loads beyond" not in texts(made, "text")


def test_the_loads_alone_where_they_were_asked_for(sound):
    words = texts(section(given(sound, terms="linear")), "text")
    assert "no others were searched for" in words and "spurious" not in words


def test_without_a_model_the_page_says_so(sound):
    made = section(given(replace(sound, all_trims=None)))
    assert "There is no calibration model of all trims" in texts(made, "text")
    assert not list(pictures(made.blocks))


def test_sequences_are_those_of_the_model(spoiled):
    known = split_load_series(spoiled.all_trims)
    assert tuple(one.words for one in known if one.used) == spoiled.all_trims.model.load_series
    (lost,) = (one for one in known if not one.used)
    assert lost.words == spoiled.all_trims.suspect_series[0].load_series
    assert [name for name, bad in zip(spoiled.all_trims.model.channel_names, lost.bad, strict=True) if bad] == [
        "y2.strain"
    ]
    np.testing.assert_array_equal(np.concatenate([one.rows for one in known]), np.arange(363))
    assert list(channel_outliers(spoiled.all_trims, 1)) == [(OUTLIER_ROW, spoiled.all_trims.outliers[0])]


def test_residuals_in_the_order_of_loading(spoiled):
    all_trims, known = spoiled.all_trims, split_load_series(spoiled.all_trims)
    figure = order_figure(all_trims, known, channel_ranges(spoiled, all_trims))
    names = all_trims.model.channel_names
    assert [axes.get_title(loc="left") for axes in figure.axes] == list(names)
    for c, axes in enumerate(figure.axes):
        drawn = next(line for line in axes.get_lines() if len(line.get_xdata()) == 363)
        np.testing.assert_allclose(drawn.get_ydata(), 1e6 * all_trims.residuals[:, c])
        hatched = [patch for patch in axes.patches if patch.get_hatch()]
        assert [patch.get_x() for patch in hatched] == [121 + 21.5]
        triangles = [line for line in axes.get_lines() if line.get_marker() == "^"]
        assert [line.get_xdata()[0] for line in triangles] == ([OUTLIER_ROW + 1] if names[c] == "y1.strain" else [])
        # The outlier lies beyond the axis and is drawn at its edge, with its number.
        assert all(line.get_ydata()[0] < axes.get_ylim()[1] for line in triangles)
    strong = {names[c] for c, axes in enumerate(figure.axes) for patch in axes.patches if _is_strong(patch)}
    assert strong == {"y2.strain"}
    assert [tick.get_text() for tick in figure.axes[-1].get_xticklabels()][:6] == list(all_trims.model.components)


def _is_strong(patch) -> bool:
    return bool(patch.get_hatch()) and patch.get_edgecolor()[2] < 0.1


def test_residuals_against_the_loads_that_moved(spoiled):
    all_trims, known = spoiled.all_trims, split_load_series(spoiled.all_trims)
    x = varied_loads(all_trims, known)
    at_first = known[0].rows
    np.testing.assert_allclose(x[at_first, 0], all_trims.loads[at_first, 0] / all_trims.model.calibrated_range[0])
    assert np.isnan(x[at_first, 1:]).all()
    figure = load_figure(all_trims, known, channel_ranges(spoiled, all_trims))
    assert [axes.get_title(loc="left") for axes in figure.axes] == list(all_trims.model.channel_names)
    drawn = next(line for line in figure.axes[3].get_lines() if line.get_marker() == "D")
    np.testing.assert_allclose(drawn.get_xdata(), 100 * x[:, 2])
    np.testing.assert_allclose(drawn.get_ydata(), 1e6 * all_trims.residuals[:, 3])


def test_a_line_is_drawn_only_where_more_than_chance_is_left():
    x = np.tile(np.linspace(-1, 1, 11), 4)
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(200, len(x)))
    assert sum(len(fit_trend(x, one)[0]) > 0 for one in noise) <= 200 * TREND_SIGNIFICANCE * 15
    places, smooth = fit_trend(x, 3 * x**2 - 2 * x + 0.1 * noise[0])
    np.testing.assert_allclose(smooth, 3 * places**2 - 2 * places, atol=0.3)
    few = np.where(np.abs(x) > 0.9, x, np.nan)
    assert len(fit_trend(few, noise[0])[0]) == len(fit_trend(np.full_like(x, np.nan), noise[0])[0]) == 0


def test_lines_appear_where_the_loads_alone_do_not_do():
    straight = calibrate([curved(static("bare")), curved(static("trim"))], rotor_balance(), choice=LINEAR_TERMS)
    figure = load_figure(
        straight.all_trims, split_load_series(straight.all_trims), channel_ranges(straight, straight.all_trims)
    )
    shown = {
        axes.get_title(loc="left"): [line.get_color() for line in axes.get_lines() if len(line.get_xdata()) == 60]
        for axes in figure.axes
    }
    assert {name for name, colors in shown.items() if colors} == {"x.strain", "z1.strain"}
    assert len(shown["x.strain"]) == len(shown["z1.strain"]) == 1


def test_several_calibrations_share_a_page(spoiled):
    made = build_page(given(spoiled, calibration()))
    assert made.pictures == (
        "calibration-loads",
        "calibration-order",
        "calibration-load",
        "calibration-loads-2",
        "calibration-order-2",
        "calibration-load-2",
    )
    tags = read(made.html)
    assert not tags.open and max(tags.ids.values()) == 1 and tags.references <= set(tags.ids)
    words = " ".join(tags.text)
    assert all(f"c{i}.h5: calibration model of all trims" in words for i in (0, 1))


def test_one_channel_and_one_sequence_make_a_page():
    geometry = one_degree_of_freedom()
    loads = loading(components=("Fz",))
    run = static_run(geometry, np.eye(6)[2:3] * 0.002, loads, np.random.default_rng(1))
    made = section(given(calibrate([run], geometry)))
    assert "21 rows of s1 in one load series." in texts(made, "text")
    assert row_of(made, "nonlinear terms", "z.strain")[4:] == ["–", "–", "–"]
    assert len(list(pictures(made.blocks))) == 3


def test_load_points_are_numbered_where_the_names_of_sequences_have_no_room(spoiled, monkeypatch):
    monkeypatch.setattr(math_model_figures, "PAGE_INCHES", 4.0)
    figure = order_figure(
        spoiled.all_trims, split_load_series(spoiled.all_trims), channel_ranges(spoiled, spoiled.all_trims)
    )
    assert figure.axes[-1].get_xlabel() == "load point, in the order of loading"


@pytest.mark.parametrize(
    ("unit", "symbol", "text"),
    [("mV/V", "\N{MICRO SIGN}V/V", "8"), ("count", "count", "8e-06"), ("V", "\N{MICRO SIGN}V", "8")],
)
def test_readings_are_shown_in_their_unit(unit, symbol, text):
    channels = [Channel(name="B1", unit=unit), Channel(name="B2", unit=unit)]
    scale = reading_scale(Geometry(format="balance-geometry/1", name="g", rig="g", channels=channels), ["B1", "B2"])
    assert scale.symbol == symbol and f"{8e-6 * scale.per_base_unit:.3g}" == text
    mixed = [Channel(name="B1", unit="mV/V"), Channel(name="B2")]
    assert (
        reading_scale(Geometry(format="balance-geometry/1", name="g", rig="g", channels=mixed), ["B1", "B2"]).symbol
        == "\N{MICRO SIGN}V"
    )
