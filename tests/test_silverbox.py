"""A real measurement: the Silverbox as a balance of one degree of freedom, its fit integrated in time."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from balance_cli.geometry_file import geometry_from_dict
from balance_cli.identify import identified_effects, identify
from balance_cli.model.placed_effects import add_effects
from balance_cli.simulation import true_rig
from balance_cli.simulation.extensions import apply_effects
from balance_cli.simulation.mechanics import equations_of_motion
from balance_cli.simulation.motion import Motion, nonlinear_forces
from balance_cli.spectra import measured_spectra

PROJECT = Path(__file__).parents[1]
CSV = PROJECT.parent / "shared" / "measured" / "silverbox" / "SNLS80mV.csv"
OVERSAMPLING = 4
SETTLED = 50

pytestmark = pytest.mark.skipif(not CSV.exists(), reason="the measured data are not here")


def load_tool():
    spec = importlib.util.spec_from_file_location("silverbox", PROJECT / "tools" / "silverbox.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def silverbox():
    return load_tool()


@pytest.fixture(scope="module")
def runs(silverbox):
    return silverbox.silverbox_runs(CSV)


@pytest.fixture(scope="module")
def spectra(silverbox, runs):
    return measured_spectra([runs["train"]], geometry_from_dict(silverbox.GEOMETRY), means=True)


def fit(silverbox, spectra, *effects):
    return identify(spectra, add_effects(geometry_from_dict(silverbox.GEOMETRY), effects))


@pytest.fixture(scope="module")
def closed(silverbox, spectra):
    return fit(silverbox, spectra, "load-offset@Fz", "cubic-stiffness@z,beside")


def simulated(model, loads, rate):
    """The channel (n,) [V] under recorded loads (n,) [N], band-limited between samples, integrated from rest."""
    value = dict(zip(model.parameters.names, model.parameters.value, strict=True))
    rig = true_rig(
        model.geometry,
        mass=value["mass"],
        stiffness=[value["stiffness.z"]],
        damping_ratios=[value["damping_ratio.1"]],
        sensitivities=[value["sensitivity.z"]],
    )
    rig = apply_effects(rig, [effect for effect in model.geometry.effects if "stiffness" in effect.name])
    motion, step = Motion.of(equations_of_motion(rig)), 1.0 / (rate * OVERSAMPLING)
    n = len(loads)
    spectrum = np.zeros(OVERSAMPLING * n // 2 + 1, complex)
    spectrum[: n // 2 + 1] = np.fft.rfft(loads)
    fine = np.zeros((OVERSAMPLING * n, 6))
    fine[:, 2] = np.fft.irfft(spectrum, OVERSAMPLING * n) * OVERSAMPLING - value.get("load-offset@Fz.offset", 0.0)
    extra = nonlinear_forces(motion, [fine], step)[0] if motion.mechanics.forces else np.zeros((len(fine), 0))
    force = motion.forces(fine, extra, step)[::OVERSAMPLING, 0]
    return force * value["sensitivity.z"] + value.get("channel-offset@z.offset", 0.0)


def errors(model, runs):
    """RMSE [mV] on the test part of the multisines (integrated from the first of all on) and on the arrow head."""
    parts = [np.hstack([run.read().channels, run.read().loads[:, 2:3]]) for run in runs.values()]
    train, test, arrow = parts
    multisines = np.vstack([train, test])
    rate = runs["train"].sample_rate
    wrong = [simulated(model, part[:, 1], rate) - part[:, 0] for part in (multisines, arrow)]
    kept = wrong[0][len(train) + SETTLED :], wrong[1][SETTLED:]
    return tuple(1e3 * float(np.sqrt(np.mean(part**2))) for part in kept)


def test_linear_it_is_as_wrong_as_known(silverbox, spectra, runs):
    test, arrow = errors(fit(silverbox, spectra), runs)
    assert test == pytest.approx(8.64, abs=0.1)
    assert arrow == pytest.approx(15.3, abs=0.4)


def test_load_offset_and_a_cubic_spring_beside_the_cell_close_it(closed, runs):
    test, arrow = errors(closed, runs)
    assert test < 0.41
    assert arrow < 0.50
    found = {effect.name: effect.parameters[0] for effect in identified_effects(closed)}
    assert found["cubic-stiffness"].value > 30 * found["cubic-stiffness"].sigma
    assert found["load-offset"].value == pytest.approx(0.0053, abs=0.0005)


def test_the_side_is_beside(silverbox, spectra, closed):
    inside = fit(silverbox, spectra, "load-offset@Fz", "cubic-stiffness@z,inside")
    assert inside.quality.chi2 > 10 * closed.quality.chi2


def test_a_quadratic_stiffness_gains_nothing_beyond_an_offset(silverbox, spectra, closed):
    effects = ("load-offset@Fz", "cubic-stiffness@z,beside")
    offset = fit(silverbox, spectra, *effects, "channel-offset@z")
    quadratic = fit(silverbox, spectra, *effects, "quadratic-stiffness@z,beside")
    both = fit(silverbox, spectra, *effects, "channel-offset@z", "quadratic-stiffness@z,beside")
    assert closed.quality.chi2 - quadratic.quality.chi2 < 10.0
    assert offset.quality.chi2 - both.quality.chi2 < 1.0
