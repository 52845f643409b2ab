"""Terms that the user chooses: a family, a list, a file or a level of significance."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.fit import CalibrationPoints, fit_calibration_model
from balance_cli.calibration.selection import select_terms
from balance_cli.calibration.term_choice import (
    LISTED,
    QUADRATIC,
    TermChoice,
    choice_of_lines,
    choice_of_words,
    parse_term,
    require_known_names,
)
from balance_cli.calibration.term_support import find_supported_terms
from balance_cli.calibration.terms import all_terms, term_values
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.cli import balance
from balance_cli.cli.calibration_text import math_model_warnings
from balance_cli.io.errors import UserError
from tests.support.calibration_stand import CHANNELS, stand_loads, stand_points

GEOMETRY = """format: balance-geometry/1
name: a
rig: three
channels: [{name: B1, unit: mV/V}, {name: B2, unit: mV/V}, {name: B3, unit: mV/V}]
components: [{name: A, direction: [-1, 0, 0]}, {name: N, direction: [0, 0, -1]}, {name: Pm, moment: [0, 1, 0]}]
"""


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("Fx^2", "Fx^2"),
        (" Fx Fx ", "Fx^2"),
        ("Fy*Fx", "Fx Fy"),
        ("Mz|Fx|", "|Fx| Mz"),
        ("|Mz Fx|", "|Fx Mz|"),
        ("Fx²", "Fx^2"),
        ("|Fz^3|", "|Fz^3|"),
    ],
)
def test_terms_are_understood_as_they_are_written(text, name):
    assert parse_term(text, COMPONENTS).name(COMPONENTS) == name


def test_a_component_that_looks_like_a_power_is_none():
    """Beside a component N2 the square of N is N^2 only."""
    components = ("N", "N2", "A")
    assert parse_term("N2", components).linear
    assert parse_term("N^2", components).name(components) == "N^2"
    with pytest.raises(UserError, match="unknown term"):
        parse_term("A2", components)


def test_quadratic_has_all_squares_and_products():
    points = stand_points()
    model = fit_calibration_model(points, TermChoice(QUADRATIC)).model
    assert len(model.terms) == 6 + 21
    assert np.isfinite(model.t).all()
    # The same as plain least squares with these columns and a zero for each load series.
    x = points.x
    squares = [x[:, i] * x[:, j] for i in range(6) for j in range(i, 6)]
    columns = np.column_stack([x, *squares, np.eye(int(points.load_series.max()) + 1)[points.load_series]])
    expected = np.linalg.lstsq(columns, points.channels, rcond=None)[0][:6]
    np.testing.assert_allclose(model.coefficients[:6], expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())


def test_listed_terms_are_those_of_their_channel():
    choice = choice_of_lines(["# a comment", "Fx Fy, Mz^2  # both", f"{CHANNELS[0]}: |Fz|"], "terms.txt", COMPONENTS)
    model = fit_calibration_model(stand_points(), choice).model
    assert set(model.terms[6:]) == {"Fx Fy", "Mz^2", "|Fz|"}
    own = {name: [t for t in model.channel_coefficients(name) if t not in COMPONENTS] for name in CHANNELS[:2]}
    assert sorted(own[CHANNELS[0]]) == ["Fx Fy", "Mz^2", "|Fz|"]
    assert sorted(own[CHANNELS[1]]) == ["Fx Fy", "Mz^2"]


def test_what_the_other_terms_explain_is_left_out_with_its_reason():
    """Poses with c = a b + b^2 + a^2: each term differs from every other, and one is a sum of the others."""
    names, block = ("a", "b", "c"), np.zeros(200, np.intp)
    a, b = np.random.default_rng(1).uniform(-1.0, 1.0, (2, 200))
    x = np.column_stack([a, b, a * b + b**2 + a**2])
    terms = (*all_terms(3)[:3], *(parse_term(name, names) for name in ("a^2", "b^2", "a b")))
    assert not find_supported_terms(terms, x, block, names).unsupported
    jointly = find_supported_terms(terms, x, block, names, jointly=True)
    assert {term.name(names): why for term, why in jointly.unsupported.items()} == {
        "a b": "the other terms together explain it in this schedule"
    }


def test_significance_is_that_of_the_search():
    """Noise alone: what is added rises with the level that is asked for."""
    x, sequence = stand_loads()
    X = term_values(all_terms(6), x)
    Y = np.random.default_rng(8).normal(size=(len(x), 20))
    added = [
        sum(len(each) > 6 for each in select_terms(X, Y, sequence, sequence, 6, significance=level))
        for level in (1e-6, 0.99)
    ]
    assert added[0] == 0
    choice = choice_of_words("search", 1e-6)
    assert choice.significance == 1e-6 and choice.is_search


def test_a_list_needs_names_of_this_balance():
    with pytest.raises(UserError, match=r"unknown term `Fx Fq`.*Is it `Fx F"):
        require_known_names(TermChoice(LISTED, listed=("Fx Fq",)), CHANNELS, COMPONENTS, "")
    with pytest.raises(UserError, match="no channel `gg`"):
        require_known_names(TermChoice(LISTED, by_channel={"gg": ("Fx^2",)}), CHANNELS, COMPONENTS, "t.txt")
    with pytest.raises(UserError, match="lists no term"):
        choice_of_lines(["# nothing", ""], "t.txt", COMPONENTS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A balance of three components whose B1 reads N^2, loaded singly and in pairs."""
    folder = tmp_path_factory.mktemp("terms")
    (folder / "g.yaml").write_text(GEOMETRY)
    rng = np.random.default_rng(4)
    ramp = np.array([0.0, 0.5, 1.0, 0.5, 0.0, -0.5, -1.0, -0.5, 0.0])
    x = np.vstack([np.outer(ramp, np.eye(3)[i]) + 0.6 * np.eye(3)[j] * (i != j) for i in range(3) for j in range(3)])
    series = np.repeat(np.arange(9), len(ramp))
    readings = x @ np.array([[1.0, 0.1, 0.0], [0.05, 1.0, 0.1], [0.0, 0.1, 1.0]])
    readings[:, 0] += 0.02 * x[:, 1] ** 2
    readings += 1e-4 * rng.normal(size=readings.shape)
    lines = ["series,A [N],N [N],Pm [N m],B1 [mV/V],B2 [mV/V],B3 [mV/V]"]
    for number, load, reading in zip(series, x * [100.0, 500.0, 20.0], readings, strict=True):
        lines.append(",".join([str(number), *(f"{value:.6f}" for value in (*load, *reading))]))
    (folder / "p.csv").write_text("\n".join(lines) + "\n")
    return folder


def run(folder, *words, status=0):
    calibrate = [
        "calibrate",
        "-g",
        folder / "g.yaml",
        folder / "p.csv",
        "-o",
        folder / "c.h5",
        "--json",
        folder / "c.json",
    ]
    result = CliRunner().invoke(balance, [str(word) for word in (*calibrate, *words)])
    assert result.exit_code == status, result.output
    return json.loads((folder / "c.json").read_text()) if status == 0 else result.output


def test_the_call_and_its_summary(folder):
    summary = run(folder)["all_trims"]
    (folder / "c.h5").rename(folder / "earlier.h5")
    assert summary["term_choice"] == {"kind": "search", "significance": 0.01, "all": [], "by_channel": {}}
    assert list(summary["terms"]["B1"]) == ["N^2"] and not summary["terms"]["B2"]
    # An earlier calibration gives its terms, by channel.
    again = run(folder, "--terms", folder / "earlier.h5")["all_trims"]
    assert again["term_choice"]["by_channel"] == {"B1": ["N^2"], "B2": [], "B3": []}
    assert again["terms"]["B1"]["N^2"]["value"] == pytest.approx(summary["terms"]["B1"]["N^2"]["value"], rel=1e-9)
    quadratic = run(folder, "--terms", "quadratic")["all_trims"]
    assert len(quadratic["terms"]["B2"]) == 6
    listed = run(folder, "--terms", "N*N, |A|")["all_trims"]
    assert set(listed["terms"]["B2"]) == {"N^2", "|A|"} and listed["term_choice"]["all"] == ["N*N", "|A|"]
    assert run(folder, "--significance", "0.001")["all_trims"]["term_choice"]["significance"] == 0.001


def test_calls_that_cannot_be_meant(folder):
    assert "Is it `N^2`?" in run(folder, "--terms", "N^22", status=2)
    assert "is no file, and no term" in run(folder, "--terms", "none/terms.txt", status=2)
    assert "without a search" in run(folder, "--terms", "linear", "--significance", "0.1", status=2)
    assert "nan is not a number" in run(folder, "--significance", "nan", status=2)
    poses = np.random.default_rng(2).uniform(-1.0, 1.0, (10, 3))
    lines = ["A [N],N [N],Pm [N m],B1 [mV/V],B2 [mV/V],B3 [mV/V]"]
    lines += [",".join(f"{value:.5f}" for value in (*pose, *pose)) for pose in poses]
    (folder / "few.csv").write_text("\n".join(lines))
    words = ["calibrate", "-g", str(folder / "g.yaml"), str(folder / "few.csv"), "-o", str(folder / "d.h5")]
    result = CliRunner().invoke(balance, [*words, "--terms", "quadratic"])
    assert result.exit_code == 2 and "10 load points in 1 load series do not determine" in result.output
    assert not (folder / "d.h5").exists()


def test_a_file_may_be_yaml_and_a_wrong_term_is_named_with_its_line():
    text = ["g1:", "  - Fx^2", "  - '|Fz|'", "g2: [Fx Fy, Mz^2]", "Fy^2"]
    choice = choice_of_lines(text, "terms.yaml", COMPONENTS)
    assert choice.by_channel == {"g1": ("Fx^2", "|Fz|"), "g2": ("Fx Fy", "Mz^2")} and choice.listed == ("Fy^2",)
    with pytest.raises(UserError, match=r"line 2.*unknown term `Fx Fw`"):
        choice_of_lines(["Fx^2", "g1: Fx Fw"], "t.txt", COMPONENTS)


def test_listed_terms_that_the_loads_hardly_tell_are_named_with_their_variance_inflation():
    """Squares and cubes of loads near their range are alike: the inflation was in a table, far above any limit."""
    rng = np.random.default_rng(3)
    x = np.vstack([np.outer(np.r_[0.0, 0.9, 0.92, 0.94, 0.96, 0.98, 1.0], row) for row in np.eye(2)])
    read = x @ rng.standard_normal((2, 3)) + 1e-4 * rng.standard_normal((len(x), 3))
    run, ones = np.zeros(len(x), np.intp), np.ones(len(x))
    points = CalibrationPoints(tuple("abc"), ("Fx", "Fz"), ("r",), read, x, run, ones, np.ones(2))
    made = calibrate_all_trims(points, choice=TermChoice(LISTED, listed=("Fx^2", "Fx^3")))
    (said,) = (text for text in math_model_warnings(made) if "hardly separate" in text)
    assert "`Fx^2`, `Fx^3` from each other" in said and "1000 at the most" in said
