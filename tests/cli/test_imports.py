"""What a command imports: half a second of processor time, told by the modules that it loads."""

import json
import subprocess
import sys

import pytest

from balance_cli.campaign.recording.run_file import write_run
from balance_cli.campaign.rig.geometry_file import save_geometry
from balance_cli.io.artefacts import Provenance, save_artefact
from balance_cli.io.formats import LOADS_FORMAT
from balance_cli.reduction.result import HubLoads

MADE = Provenance("a-test", {}, (), {}, "2026-01-02T03:04:05+00:00")
HEAVY = {"scipy.interpolate", "scipy.optimize", "scipy.signal", "scipy.spatial", "scipy.stats", "matplotlib", "pandas"}
HEAVY |= {"numpy.f2py", "numpy.testing"}
"""Each of them takes longer than the data reduction of a run."""
PROGRAM = """
import json, sys
from balance_cli.cli import balance
balance(json.loads(sys.argv[1]), standalone_mode=False)
print(json.dumps(list(sys.modules)))
"""
RESPONSE = ("--calibration", "cal.h5", "--model", "model.h5")
CALLS = {
    "modes": (("modes", "-g", "geometry.yaml"), 138),
    "check": (("check", "wind.h5"), 118),
    "sweep-tf": (("sweep-tf", "-g", "geometry.yaml", "sweep.h5", "-o", "tf.h5"), 153),
    "identify": (("identify", "-g", "geometry.yaml", "--method", "ls", "sweep.h5", "-o", "new.h5"), 233),
    "reduce": (("reduce", *RESPONSE, "wind.h5", "-o", "loads.h5"), 249),
    "export": (("export", "made.h5", "-o", "made.csv"), 158),
}
"""Words of each call, and the modules of the package that it may load beside the effects: a tenth more than it does."""
EFFECT_FILES = "balance_cli.model.effects."
"""The library, one small file an effect: a command that knows one knows all, and their number is none of its doing."""


@pytest.fixture(scope="module")
def folder(campaign, calibration, identified, tmp_path_factory):
    """A geometry, a sweep, a wind run, and what they are reduced by."""
    folder = tmp_path_factory.mktemp("imports")
    save_geometry(folder / "geometry.yaml", campaign.geometry)
    save_artefact(folder / "cal.h5", "balance-calibration/1", calibration, MADE)
    save_artefact(folder / "model.h5", "balance-model/1", identified, MADE)
    for kind in ("sweep", "wind"):
        write_run(folder / f"{kind}.h5", campaign.runs_of_kind(kind)[0])
    loads = HubLoads("harmonic", "none", campaign.geometry, {})
    save_artefact(folder / "made.h5", LOADS_FORMAT, loads, MADE)
    return folder


def loaded_modules(folder, *words):
    call = [sys.executable, "-c", PROGRAM, json.dumps([*words, "-q"])]
    done = subprocess.run(call, capture_output=True, text=True, check=False, cwd=folder)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("name", CALLS)
def test_a_command_loads_what_it_needs(folder, name):
    words, limit = CALLS[name]
    modules = loaded_modules(folder, *words)
    assert HEAVY & set(modules) == set()
    own = [module for module in modules if module.partition(".")[0] == "balance_cli"]
    assert len([module for module in own if not module.startswith(EFFECT_FILES)]) <= limit


def test_a_page_without_a_plan_loads_no_simulation(folder):
    modules = loaded_modules(folder, "report", "cal.h5", "-o", "page.html")
    assert not [module for module in modules if module.startswith("balance_cli.simulation")]


@pytest.mark.parametrize("version", [None, "99.0.1rc1"])
def test_docstrings_of_scipy_are_not_parsed_but_by_versions_that_are_not_known(version):
    program = "import scipy; import balance_cli.cli.lean_scipy as lean; "
    program += f"scipy.__version__ = {version!r} or scipy.__version__; "
    program += "lean.import_lean_scipy(); from scipy.fft import rfft; "
    program += "print(rfft([1.0, 1.0])[0].real); print(rfft.__doc__)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("2.0\nCompute the 1-D discrete Fourier Transform for real input.")
    assert ("Array API" in done.stdout) == (version is not None)
