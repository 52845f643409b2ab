"""The matrix as a file: written, read back, met with one message where it is bad, and used by `reduce`."""

import csv
import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from balance_cli.calibration.matrix import matrix_from_model, model_from_matrix, term_unit
from balance_cli.calibration.matrix_file import read_matrix_file
from balance_cli.calibration.matrix_reader import read_matrix
from balance_cli.calibration.matrix_text import FORMAT, matrix_csv, matrix_text
from balance_cli.calibration.result import Calibration
from balance_cli.calibration.terms import all_terms, term_values
from balance_cli.campaign.recording.channel_health import ChannelHealth
from balance_cli.campaign.recording.run_file import write_run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.cli import balance
from balance_cli.io.artefacts import load_artefact
from balance_cli.io.errors import UserError
from balance_cli.reduction.mean_loads import linear_mean_loads
from balance_cli.reduction.mean_loads_nonlinear import nonlinear_mean_loads
from balance_cli.reduction.response_sources import static_source
from balance_cli.reduction.wind_off import zero_record
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.calibration_from_matrix import MATRIX_TRIM, NOT_IN_MATRIX, calibration_from_matrix
from balance_cli.steps.reduce import ERRORS_UNKNOWN, reduce_run
from tests.support.nonlinear_rig import NAMES, RIG, calibration, readings, record, spectra, static_runs
from tests.support.rigs import CONFIGS, one_degree_of_freedom
from tests.support.static_runs import without

MODEL = calibration().all_trims.model
CSV = matrix_csv(matrix_from_model(MODEL, RIG.rig))
LINES = CSV.splitlines()
LOADS = np.array([300.0, -200.0, 2000.0, 100.0, -80.0, 150.0])
G = ["-g", str(CONFIGS / "rts-6.yaml")]


def line_of(name):
    """Number, from 0, of the line with this name."""
    return next(i for i, line in enumerate(LINES) if next(csv.reader([line]))[0] == name)


def changed(name, change):
    """The file with the cells of one line changed (None takes it out)."""
    cells = change(next(csv.reader([LINES[line_of(name)]])))
    lines = list(LINES)
    lines[line_of(name)] = None if cells is None else ",".join(cells)
    return "\n".join(line for line in lines if line is not None)


def cell(number, text):
    """Change of one cell."""
    return lambda cells: [*cells[:number], text, *cells[number + 1 :]]


def call(*words):
    return CliRunner().invoke(balance, [str(word) for word in words])


# ---- layout ----------------------------------------------------------------------------------------------------------


def test_the_layout_is_that_of_balance_practice():
    assert LINES[0] == FORMAT == "balance-matrix/1"
    rows = [next(csv.reader([line])) for line in LINES[line_of("term") + 1 :]]
    assert len(rows) == 96 and {len(row) for row in rows} == {2 + len(NAMES)}
    names = [row[0] for row in rows]
    # The ten families of AIAA R-091, in their order.
    assert names[:6] == list(COMPONENTS)
    starts = ("|Fx|", "Fx^2", "Fx|Fx|", "Fx Fy", "|Fx Fy|", "Fx |Fy|", "|Fx| Fy", "Fx^3", "|Fx^3|")
    assert [names.index(name) for name in starts] == [6, 12, 18, 24, 39, 54, 69, 84, 90]
    rows_by_name = {row[0]: row for row in rows}
    z1 = 2 + NAMES.index("z1.strain")
    assert float(rows_by_name["Fz^2"][z1]) == pytest.approx(0.008 / 3500**2, rel=0.05)
    assert float(rows_by_name["Fy^2"][z1]) == 0.0 and float(rows_by_name["Fz|Fz|"][z1]) == 0.0


def test_units_of_coefficients():
    units = {term.name(COMPONENTS): term_unit(term, COMPONENTS) for term in all_terms(6)}
    expected = {
        "Fx": "V/N",
        "|My|": "V/(N m)",
        "Fx^2": "V/N^2",
        "My|My|": "V/(N m)^2",
        "Fx Fz": "V/N^2",
        "|Fx My|": "V/(N (N m))",
        "Mx |My|": "V/(N m)^2",
        "|Fz^3|": "V/N^3",
        "Mz^3": "V/(N m)^3",
    }
    assert {name: units[name] for name in expected} == expected


def test_coefficients_are_those_of_the_readings_in_engineering_units():
    matrix = matrix_from_model(MODEL, RIG.rig)
    by_matrix = term_values(all_terms(6), LOADS[None]) @ matrix.coefficients
    np.testing.assert_allclose(by_matrix, MODEL.readings(LOADS[None]), rtol=1e-12, atol=1e-15)


def test_the_file_gives_back_the_model():
    found = model_from_matrix(read_matrix(CSV).matrix)
    assert (found.terms, found.channel_names, found.components) == (MODEL.terms, NAMES, COMPONENTS)
    for name in ("coefficients", "residual_covariance", "calibrated_range", "largest_load", "smallest_load", "dof"):
        np.testing.assert_allclose(getattr(found, name), getattr(MODEL, name), rtol=1e-13, atol=1e-30)
    np.testing.assert_allclose(found.zeros[0], MODEL.zeros.mean(axis=0), rtol=1e-13)
    volts = MODEL.readings(np.random.default_rng(0).uniform(-0.9, 0.9, (100, 6)) * MODEL.calibrated_range)
    (ours, _), (theirs, solved) = MODEL.loads(volts), found.loads(volts)
    assert solved.all()
    np.testing.assert_allclose(theirs, ours, rtol=1e-9, atol=1e-9)


def test_the_file_is_the_same_when_it_is_read_and_written_again():
    assert read_matrix(matrix_csv(read_matrix(CSV).matrix)).matrix.term_names == matrix_from_model(MODEL, "").term_names
    again = matrix_csv(read_matrix(CSV).matrix)
    assert again == CSV


def test_what_spreadsheets_do_to_a_file_does_not_matter():
    width = max(line.count(",") for line in LINES)
    padded = [line + "," * (width - line.count(",")) for line in LINES]
    comment = ["# from the spreadsheet", "", ",,,"]
    text = "\ufeff" + "\r\n".join([padded[0], *comment, *padded[1:]]) + "\r\n\r\n"
    assert matrix_csv(read_matrix(text).matrix) == CSV
    loose = CSV.replace("Fx Fy,", "FxFy,").replace("V/(N (N m))", "V/(N(N m))")
    assert matrix_csv(read_matrix(loose).matrix) == CSV
    head, terms = LINES[: line_of("term") + 1], LINES[line_of("term") + 1 :]
    assert matrix_csv(read_matrix("\n".join([*head, *reversed(terms)])).matrix) == CSV


def test_correlations_need_not_be_stated():
    plain = "\n".join(line for line in LINES if not line.startswith("correlation"))
    matrix = read_matrix(plain).matrix
    np.testing.assert_array_equal(matrix.correlation, np.eye(len(NAMES)))
    assert "correlation" not in matrix_csv(matrix)


def test_the_text_for_reading_has_the_same_in_columns():
    lines = matrix_text(matrix_from_model(MODEL, RIG.rig)).splitlines()
    assert lines[0] == "balance-matrix/1 for reading"
    table = [line for line in lines if line.startswith(("term ", "Fz^2 ", "|Fx^3| ", "channel "))]
    assert len(table) == 4 and len({len(line) for line in table[1:]}) == 1
    assert sum("V/" in line for line in lines) == 96
    value = MODEL.coefficients[MODEL.terms.index("Fz^2"), NAMES.index("z1.strain")] / MODEL.calibrated_range[2] ** 2
    assert f"{value:.7g}" in next(line for line in lines if line.startswith("Fz^2"))


# ---- bad files -------------------------------------------------------------------------------------------------------

BAD = {
    "empty": ("", "line 1: is empty"),
    "another file": ("run,component\n1,2", "line 1: begins with `run`"),
    "another version": (CSV.replace("matrix/1", "matrix/7", 1), "line 1: is of format `balance-matrix/7`"),
    "semicolons": (CSV.replace(",", ";"), "line 2: is separated by semicolons"),
    "text for reading": (matrix_text(matrix_from_model(MODEL, "")), "line 1: is the text for reading"),
    "missing header": (changed("zero", lambda _: None), "before `term`: there is no line `zero`"),
    "no terms": ("\n".join(LINES[: line_of("term")]), "there is no line `term`"),
    "twice": ("\n".join([*LINES[:5], *LINES[4:]]), "line 6, `component`: is there twice, first in line 5"),
    "unknown header": (
        changed("zero", cell(0, "zeroes")),
        "`zeroes`: is not a line of the header. Did you mean `zero`?",
    ),
    "no component": (changed("component", cell(2, "Lift")), "line 5, `component`: `Lift` is not a load component"),
    "unit of a component": (changed("unit", cell(4, "lb")), "line 6, `unit`, Fz: `lb`, where `N` was expected"),
    "unit of a zero": (changed("zero", cell(1, "mV")), "`zero`: has the unit `mV`, where `V` was expected"),
    "unit where none is expected": (changed("full range", cell(1, "N")), "has the unit `N`, where none was expected"),
    "unit of a term": (changed("Fz^2", cell(1, "V/N")), "`Fz^2`: has the unit `V/N`, where `V/N^2` was expected"),
    "missing channel": (changed("term", lambda c: c[:-1]), "`term`: channel `torque` is missing"),
    "channels swapped": (changed("term", lambda c: [*c[:2], c[3], c[2], *c[4:]]), "in another order than `channel`"),
    "channel twice": (changed("channel", cell(3, "x.strain")), "`channel`: `x.strain` is there twice"),
    "too few channels": (changed("channel", lambda c: c[:7]), "5 channels cannot determine 6 loads"),
    "a value missing": (changed("My^3", lambda c: c[:-1]), "`My^3`: has 7 values, where 8 are expected, `torque` is"),
    "a value too many": (changed("My^3", lambda c: [*c, "0"]), "`My^3`: has 9 values, where 8 are expected"),
    "not a number": (changed("Fz^2", cell(5, "1.5 uV")), "`Fz^2`, z1.strain: `1.5 uV` is not a number"),
    "nan": (changed("Fz^2", cell(5, "nan")), "`nan` is not a number"),
    "infinite": (changed("Fz^2", cell(5, "1e999")), "`1e999` is not a number"),
    "empty cell": (changed("Fz^2", cell(5, "")), "`Fz^2`, z1.strain: `` is not a number"),
    "grouped": (changed("Fz^2", cell(5, "1_0")), "`1_0` is not a number"),
    "unknown term": (
        changed("Fz^3", cell(0, "Fz^4")),
        "`Fz^4`: is not a term of these components. Did you mean `Fz^3`?",
    ),
    "missing term": (changed("Mz^3", lambda _: None), "there is no line for the term `Mz^3`"),
    "cut short": ("\n".join(LINES[:-3]), "there is no line for the term `|Mx^3|`"),
    "term twice": (changed("Mz^3", cell(0, "My^3")), "`My^3`: is there twice"),
    "full range": (changed("full range", cell(2, "0")), "`full range`, Fx: 0 is not between"),
    "range of loads": (changed("smallest load", cell(2, "1e4")), "`largest load`, Fx: 800 is not above"),
    "residual": (changed("residual standard deviation", cell(2, "0")), "`residual standard deviation`, x.strain: 0 is"),
    "correlation": (changed("correlation with x.strain", cell(3, "0.5")), "is not symmetric"),
    "correlation of none": (changed("correlation with x.strain", cell(0, "correlation with q")), "`q` is not among"),
    "correlation missing": (changed("correlation with x.strain", lambda _: None), "there is no line `correlation with"),
    "incredible": (changed("Fz^2", cell(5, "3")), "`Fz^2`, z1.strain: 3 contributes more than 1e+06 V"),
    "linear part without Mz": (changed("Mz", lambda c: [*c[:2], *["0"] * 8]), "do not determine the loads"),
    "quotes": (CSV.replace("Fz^2,", '"Fz^2,', 1), "is not a line of a CSV file"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_met_by_one_message(name, tmp_path):
    text, message = BAD[name]
    path = tmp_path / "m.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UserError) as caught:
        read_matrix_file(path)
    error = caught.value
    assert message in str(error), str(error)
    assert (
        error.file == str(path) and "line " in error.place and error.fault and error.remedy and "\n" not in str(error)
    )


def test_what_is_no_text_is_met_by_one_message(tmp_path):
    path = tmp_path / "m.csv"
    for content, message in (
        (b"\x89HDF\r\n\x1a\n", "is not UTF-8 text"),
        (b"balance-matrix/1\n\xff", "line 2: is not UTF-8"),
    ):
        path.write_bytes(content)
        with pytest.raises(UserError, match=message):
            read_matrix_file(path)
    with pytest.raises(UserError, match="no such file"):
        read_matrix_file(tmp_path / "none.csv")
    with pytest.raises(UserError, match="is a folder"):
        read_matrix_file(tmp_path)


CELLS = st.sampled_from(
    [
        "",
        "nan",
        "1e308",
        "-1e308",
        "1e-320",
        "0",
        "-1",
        "1",
        "x",
        "V",
        "N",
        '"',
        "term",
        "Fx",
        "|Fx|",
        "channel",
        "\x00",
        "é",
        "9" * 400,
    ]
) | st.floats().map(repr)


@st.composite
def mutated(draw):
    """The file after a few accidents: cells, lines and characters changed, doubled, moved or lost."""
    rows = [next(csv.reader([line])) for line in LINES]
    for _ in range(draw(st.integers(1, 3))):
        i, kind = (
            draw(st.integers(0, len(rows) - 1)),
            draw(st.sampled_from(["cell", "drop", "double", "move", "cut", "swap"])),
        )
        if kind == "cell":
            j = draw(st.integers(0, max(len(rows[i]) - 1, 0)))
            rows[i] = [*rows[i][:j], draw(CELLS), *rows[i][j + 1 :]]
        elif kind == "drop":
            rows.pop(i)
        elif kind == "double":
            rows.insert(i, rows[i])
        elif kind == "move":
            rows.insert(draw(st.integers(0, len(rows) - 1)), rows.pop(i))
        elif kind == "cut":
            rows[i] = rows[i][: draw(st.integers(0, len(rows[i])))]
        else:
            rows[i] = [draw(CELLS) for _ in rows[i]]
    return "\n".join(",".join(row) for row in rows)


@settings(max_examples=400, deadline=None)
@given(mutated())
def test_the_reader_raises_nothing_but_user_errors(text):
    try:
        stated = read_matrix(text)
        calibration_from_matrix(stated, RIG).all_trims.model.contraction()
    except UserError as error:
        assert error.fault and error.remedy and error.place


@settings(max_examples=200, deadline=None)
@given(st.text(max_size=300), st.integers(0, len(CSV)), st.integers(0, 300))
def test_nor_does_it_where_text_is_put_into_the_file(text, at, lost):
    for whole in (text, CSV[:at] + text + CSV[at + lost :]):
        try:
            calibration_from_matrix(read_matrix(whole), RIG)
        except UserError as error:
            assert error.fault and error.remedy and error.place


# ---- as a calibration ------------------------------------------------------------------------------------------------


def test_a_stated_calibration_is_the_straight_part_at_zero_load_and_the_model():
    cal = calibration_from_matrix(read_matrix(CSV), RIG)
    trim = cal.trims[MATRIX_TRIM]
    np.testing.assert_allclose(trim.C0, MODEL.coefficients[:6].T / MODEL.calibrated_range, rtol=1e-12)
    np.testing.assert_allclose(trim.T0 @ trim.C0, np.eye(6), atol=1e-9)
    np.testing.assert_allclose(trim.loads(MODEL.zeros.mean(axis=0)), 0.0, atol=1e-9)
    assert not cal.errors_known and np.isnan(trim.C0_sigma).all() and calibration().errors_known
    assert cal.all_trims.model.is_nonlinear and cal.all_trims.model.contraction().is_proved


@pytest.mark.parametrize("curved", [True, False])
@pytest.mark.parametrize("with_zero", [True, False])
def test_mean_loads_by_the_file_are_those_by_the_model(curved, with_zero):
    model = calibration(curved).all_trims.model
    assert model.is_nonlinear == curved
    cal = calibration_from_matrix(read_matrix(matrix_csv(matrix_from_model(model, RIG.rig))), RIG)
    zero = zero_record(record("zero", np.zeros(6), kind="zero", seed=5), NAMES) if with_zero else None
    volts = 0.05 + (readings(LOADS)[0] if curved else model.readings(LOADS[None])[0])
    record_of = (spectra(volts, 1e-6), cal)
    health = ChannelHealth(NAMES, {})
    found = (
        nonlinear_mean_loads(*record_of, cal.all_trims.model, health, zero)
        if curved
        else linear_mean_loads(*record_of, health, zero)
    )
    expected = model.loads(volts - (zero.mean if zero else model.zeros.mean(axis=0)))[0][0]
    np.testing.assert_allclose(found.loads, expected, rtol=1e-9)
    assert all(("no zero" in flag) != with_zero for flag in found.flags)


def test_sigma_by_the_file_holds_the_noise_and_the_stated_residual():
    cal = calibration_from_matrix(read_matrix(CSV), RIG)
    found = reduce_run(record("w", LOADS), RIG, cal, static_source(cal))
    residual = np.sqrt(np.diagonal(MODEL.load_covariance(LOADS, MODEL.residual_covariance)[0]))
    bare = np.sqrt(np.diagonal(replace(MODEL, covariance=0 * MODEL.covariance).load_covariance(LOADS)[0]))
    assert np.all(found.sigma_cosine[0] < 1.05 * residual)
    assert np.all(found.sigma_cosine[0] >= 0.999 * bare)


def test_a_channel_that_the_matrix_lacks_is_left_out():
    run = static_runs(np.random.default_rng(1))
    lost = calibrate([without(one, "z3.strain") for one in run], RIG)
    cal = calibration_from_matrix(read_matrix(matrix_csv(matrix_from_model(lost.all_trims.model, ""))), RIG)
    assert cal.trims[MATRIX_TRIM].excluded_channels == {"z3.strain": NOT_IN_MATRIX}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("rig", cell(2, "OTHER")), "line 4, `rig`: is of rig `OTHER`, but the geometry"),
        (("channel", cell(2, "x.piezo")), "channel"),
        (("channel", cell(2, "x.strian")), "channel"),
    ],
)
def test_a_matrix_of_something_else_is_refused(change, message):
    text = changed(*change)
    if change[0] == "channel":
        name = next(csv.reader([text.splitlines()[line_of("channel")]]))[2]
        text = text.replace("x.strain", name)
        message = f"line 10, `channel`: `{name}` is not a strain or torque channel"
    with pytest.raises(UserError) as caught:
        calibration_from_matrix(read_matrix(text), RIG)
    assert str(caught.value).startswith(message)


def test_a_matrix_of_other_components_is_refused():
    with pytest.raises(UserError, match="line 5, `component`: has Fx, Fy, Fz, Mx, My, Mz, but the rig carries Fz"):
        calibration_from_matrix(read_matrix(CSV.replace("RTS-6", "ONE")), one_degree_of_freedom())


# ---- commands --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    folder = tmp_path_factory.mktemp("matrix")
    zero = record("zero", np.zeros(6), kind="zero", seed=5)
    # Four times the cutoff of the rig's filter, which is taken out of the harmonics.
    for run in (*static_runs(np.random.default_rng(1)), record("w", LOADS, rate=800.0), zero):
        write_run(folder / f"{run.name}.h5", run)
    static = sorted(folder.glob("static-*.h5"))
    done = call("calibrate", *G, *static, "-o", folder / "cal.h5", "--matrix", folder / "m.csv")
    assert done.exit_code == 0, done.output
    return folder


def mean_loads(folder, name):
    words = ["--calibration", folder / name, "--static", folder / "w.h5", folder / "zero.h5", "-o", folder / "l.csv"]
    done = call("reduce", *words, "--json", folder / "l.json")
    assert done.exit_code == 0, done.output
    table = pd.read_csv(folder / "l.csv")
    return table[table.harmonic == 0], json.loads((folder / "l.json").read_text())["runs"]["w"]


def test_there_and_back_again_gives_the_same_mean_loads(campaign):
    done = call(
        "calibrate", *G, "--from-matrix", campaign / "m.csv", "-o", campaign / "cal2.h5", "--matrix", campaign / "m.txt"
    )
    assert done.exit_code == 0, done.output
    assert "states no errors of its coefficients" in done.stderr and "Fz^2" in done.stdout
    (ours, _), (theirs, summary) = (mean_loads(campaign, name) for name in ("cal.h5", "cal2.h5"))
    np.testing.assert_allclose(theirs.cosine, ours.cosine, rtol=1e-9)
    assert summary["notes"] == [ERRORS_UNKNOWN]
    assert (campaign / "m.txt").read_text().startswith("balance-matrix/1 for reading")
    made = load_artefact(campaign / "cal2.h5", {"balance-calibration/1": Calibration})
    assert [(item.name, item.role) for item in made.provenance.inputs] == [("rts-1", "geometry"), ("m.csv", "matrix")]
    assert call("report", campaign / "cal2.h5", "-o", campaign / "r.html").exit_code == 0


def test_static_runs_check_a_matrix(campaign):
    words = ["--from-matrix", campaign / "m.csv", "--hold-out", campaign / "static-lift.h5", "-o", campaign / "cal3.h5"]
    done = call("calibrate", *G, *words, "--json", campaign / "cal3.json")
    assert done.exit_code == 0, done.output
    check = json.loads((campaign / "cal3.json").read_text())["all_trims"]["checks"]["static-lift"]
    assert check["valid_rows"] == check["rows"] and max(check["error_percent_fs"].values()) < 0.1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["{static}", "--from-matrix", "{m}"],
            "RUN..., --from-matrix: the calibration comes from runs or from a matrix",
        ),
        ([], "RUN...: no run is given"),
        (["--from-matrix", "{m}", "--terms", "linear"], "--terms, --from-matrix: a matrix has its own terms"),
        (["{static}", "--matrix", "{folder}/m.xlsx"], "m.xlsx: a matrix is written as .csv or .txt"),
        (["--from-matrix", "{bad}"], "bad.csv, line 10, `channel`: `q` is not a strain or torque channel"),
        (["--from-matrix", "{m}", "--matrix", "{m}"], "is also an input of this command"),
    ],
)
def test_a_call_that_cannot_be_meant_is_refused(campaign, tmp_path, words, message):
    (tmp_path / "bad.csv").write_text(CSV.replace("x.strain", "q"), encoding="utf-8")
    places = {"static": campaign / "static-bare.h5", "m": campaign / "m.csv", "bad": tmp_path / "bad.csv"}
    given = [word.format(folder=tmp_path, **places) for word in words]
    done = call("calibrate", *G, *given, "-o", tmp_path / "c.h5")
    assert done.exit_code == 2 and message in done.stderr and done.stderr.count("\n") == 1, done.stderr
    assert not (tmp_path / "c.h5").exists()


def test_check_knows_a_matrix(campaign, tmp_path):
    good = call("check", campaign / "m.csv", *G)
    assert good.exit_code == 0 and "calibration matrix of 8 channels for Fx, Fy, Fz, Mx, My, Mz" in good.stdout
    (tmp_path / "bad.csv").write_text(changed("Fz^2", cell(5, "x")), encoding="utf-8")
    bad = call("check", tmp_path / "bad.csv")
    assert bad.exit_code == 2 and "`x` is not a number" in bad.stdout
