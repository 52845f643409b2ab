"""A small campaign with all its artefacts, and one place that says what a refusal is."""

from dataclasses import dataclass
from pathlib import Path

import pytest
from click.testing import CliRunner

from balance_cli.cli import balance
from studies.mutation.readers import make_examples


@dataclass(frozen=True)
class Examples:
    """Files of the campaign, and calls on files that differ from them."""

    folder: Path

    def __truediv__(self, name):
        return self.folder / name

    @property
    def response(self):
        return ["--calibration", self / "cal.h5", "--model", self / "model.h5"]

    def words(self, command, bad, out):
        """A call of the command that reads the file `bad`."""
        g = ["-g", self / "geometry.yaml"]
        return {
            "check": ["check", bad],
            "check -g": ["check", *g, bad],
            "modes": ["modes", "-g", bad],
            "simulate": ["simulate", "-g", bad, "--plan", self / "plan.yaml", "--only", "wind", "-o", out / "sim"],
            "plan": ["simulate", *g, "--plan", bad, "-o", out / "sim"],
            "calibrate": ["calibrate", *g, bad, "-o", out / "o.h5"],
            "matrix": ["calibrate", *g, "--from-matrix", bad, "-o", out / "o.h5"],
            "sweep-tf": ["sweep-tf", *g, bad, "-o", out / "o.h5"],
            "reduce": ["reduce", *self.response, bad, "-o", out / "o.csv"],
            "reduce in time": ["reduce", *self.response, "--method", "kalman", bad, "-o", out / "o.csv"],
            "report": ["report", bad, "-o", out / "o.html"],
        }[command]


@pytest.fixture(scope="session")
def examples(tmp_path_factory):
    folder = tmp_path_factory.mktemp("examples")
    make_examples(folder)
    return Examples(folder)


@pytest.fixture
def out(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    return folder


def call(*words):
    return CliRunner().invoke(balance, [str(word) for word in words])


def assert_refused(done, out, *expected):
    """Exit 2, one message with these texts and a remedy (in the listing of `check`: a fault), and nothing written."""
    errors = [line for line in done.stderr.splitlines() if line.startswith("balance: error:")]
    faults = [line for line in done.stdout.splitlines() if "fault:" in line]
    assert done.exit_code == 2, done.output[-500:]
    assert len(errors) == 1 or (not errors and faults), done.output
    text = errors[0] if errors else done.stdout
    for word in expected:
        assert word in text
    assert ". " in text or "?" in text
    assert len(text) < 2000
    assert list(out.iterdir()) == []
