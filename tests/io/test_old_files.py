"""Files of former versions go through the commands that read them, for ever; those of each format are kept here."""

from pathlib import Path

import pytest
from click.testing import CliRunner

from balance_cli.cli import balance
from balance_cli.io.formats import ARTEFACT_FORMATS
from balance_cli.io.sniff import sniff_format

FILES = Path(__file__).parent / "old_files"
ARTEFACTS = Path(__file__).parent / "old_artefacts"
SAMPLE_RUN = Path(__file__).parents[2] / "sample_data" / "check-1.h5"
OF_BENCH = (ARTEFACTS / "calibration-0.2.h5", FILES / "check.h5")
OF_SAMPLE_RIG = (ARTEFACTS / "calibration.h5", SAMPLE_RUN)
NOT_READ_BY_NAME = {"balance-matrix/1", "balance-survey/1"}
"""Formats that no `format` key declares: of a CSV file, and of a file that `reduce --survey` makes anew."""


def call(*words: str | Path) -> str:
    done = CliRunner().invoke(balance, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    return done.output


def test_each_format_that_is_read_is_kept() -> None:
    import balance_cli.io.formats as formats

    declared = {value for name, value in vars(formats).items() if name.endswith("_FORMAT")}
    assert {sniff_format(path) for path in FILES.iterdir()} - {None} == declared - set(
        ARTEFACT_FORMATS
    ) - NOT_READ_BY_NAME


@pytest.mark.parametrize("path", sorted(FILES.iterdir()), ids=lambda path: path.name)
def test_check_knows_a_file_of_each_format(path: Path) -> None:
    assert "not recognized" not in call("check", path)


@pytest.mark.parametrize("name", ["transfer", "model-closed", "diagnosis", "loads-smoother", "spectra", "loads-0.2"])
def test_a_result_is_exported(name: str, tmp_path: Path) -> None:
    call("export", ARTEFACTS / f"{name}.h5", "-o", tmp_path / "result.csv")


@pytest.mark.parametrize(
    ("model", "known"),
    [("model-0.2", OF_BENCH), ("model-closed", OF_SAMPLE_RIG), ("model-paper", OF_SAMPLE_RIG)],
)
def test_loads_are_reduced_by_a_calibration_and_a_model(model: str, known: tuple[Path, Path], tmp_path: Path) -> None:
    calibration, run = known
    words = ("--calibration", calibration, "--model", ARTEFACTS / f"{model}.h5", run, "--harmonics", "2")
    call("reduce", *words, "-o", tmp_path / "loads.csv")


def test_loads_are_reduced_by_a_measured_response(tmp_path: Path) -> None:
    calibration, run = OF_BENCH
    words = ("--calibration", calibration, "--transfer", ARTEFACTS / "transfer-0.2.h5", run, "--harmonics", "2")
    call("reduce", *words, "-o", tmp_path / "loads.csv")


@pytest.mark.parametrize("names", [("loads-static", "loads-smoother"), ("loads-0.2",)])
def test_loads_are_merged_and_followed(names: tuple[str, ...], tmp_path: Path) -> None:
    loads = [ARTEFACTS / f"{name}.h5" for name in names]
    call("merge", loads[-1], "-o", tmp_path / "merged.h5")
    call("trend", *loads[:-1], tmp_path / "merged.h5", "-o", tmp_path / "trend.csv")


@pytest.mark.parametrize("version", ["0.1", "0.2"])
def test_a_history_is_exported_and_a_matrix_makes_a_calibration(version: str, tmp_path: Path) -> None:
    call("export", FILES / f"history-{version}.h5", "-o", tmp_path / "history.csv")
    matrix = FILES / f"matrix-{version}.csv"
    call("calibrate", "-g", FILES / "geometry.yaml", "--from-matrix", matrix, "-o", tmp_path / "calibration.h5")


def test_a_plan_is_simulated_and_shown(tmp_path: Path) -> None:
    call("simulate", "-g", FILES / "geometry.yaml", "--plan", FILES / "plan.yaml", "-o", tmp_path / "runs")
    call("report", FILES / "plan.yaml", "-o", tmp_path / "page.html")


def test_a_recording_is_imported_by_its_map(tmp_path: Path) -> None:
    call("import", FILES / "import-map.yaml", FILES / "recording.csv", "-o", tmp_path / "runs")
