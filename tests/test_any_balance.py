"""The page on the static calibration of any balance, executed in a temporary folder."""

import json
import re
import shlex
from pathlib import Path

import pandas as pd
import pytest
from click.testing import CliRunner

from balance_cli.cli import balance

PAGE = Path(__file__).parents[1] / "docs" / "any-balance.md"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.DOTALL | re.MULTILINE)
FILE_NAME = re.compile(r"as `([\w.-]+)`:\s*$")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder after all blocks of the page."""
    folder, text = tmp_path_factory.mktemp("page"), PAGE.read_text(encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for block in BLOCK.finditer(text):
            language, content = block.groups()
            if language != "sh":
                Path(FILE_NAME.search(text[: block.start()]).group(1)).write_text(content, encoding="utf-8")
                continue
            for line in content.splitlines():
                result = CliRunner().invoke(balance, shlex.split(line)[1:])
                assert result.exit_code == 0, f"{line}\n{result.output}"
    return folder


def test_residuals_are_those_of_the_noise(folder) -> None:
    """The table has a noise of 0.15 uV/V at a rated output of about 1 mV/V: 0.015 % of the rated load."""
    residuals = json.loads((folder / "calibration.json").read_text())["load_residuals"]
    assert set(residuals["is_rated_load"].values()) == {True}
    assert all(0.008 < value < 0.03 for value in residuals["standard_deviation_percent_fs"].values())


def test_loads_are_those_of_the_example(folder) -> None:
    loads = pd.read_csv(folder / "loads.csv")
    expected = [[20.0, 60.0, -24.0], [-30.0, 100.0, 60.0], [10.0, -140.0, 36.0], [25.0, 240.0, 0.0]]
    found = loads[["A [lbf]", "N [lbf]", "Pm [lbf in]"]].to_numpy(float)
    assert abs(found[1:] - expected).max() < 0.15
    assert loads["flag"].tolist() == ["untested"] * 4 + ["untested; extrapolated N"]


def test_the_matrix_gives_the_same_loads_without_sigma(folder) -> None:
    loads, same = pd.read_csv(folder / "loads.csv"), pd.read_csv(folder / "same-loads.csv")
    assert same["N [N]"].to_numpy() == pytest.approx(4.4482216 * loads["N [lbf]"].to_numpy(), abs=1e-3)
    assert same["sigma_N [N]"].isna().all()


def test_a_table_without_its_loads_names_those_of_the_balance(folder, monkeypatch) -> None:
    monkeypatch.chdir(folder)
    table = (
        (folder / "points.csv")
        .read_text()
        .replace("A [lbf],N [lbf],Pm [in-lbf]", "Axial [lbf],Normal [lbf],P [in-lbf]")
    )
    (folder / "renamed.csv").write_text(table)
    result = CliRunner().invoke(balance, ["calibrate", "-g", "balance.yaml", "renamed.csv", "-o", "renamed.h5"])
    assert result.exit_code == 2 and "columns such as `A [N]` or `applied A [N]`" in result.output
