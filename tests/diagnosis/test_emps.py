"""A real mechanism with dry friction: the EMPS axis as a balance, at two time scales."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry_file import geometry_from_dict
from balance_cli.diagnosis.result import EXPLAINED
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.model.placed_effects import add_effects
from balance_cli.steps.diagnose import diagnose
from balance_cli.steps.identify import IdentifyOptions, identified_effects, identify
from tests.support.measured_data import SHARED
from tests.support.tools import tool as load_tool

FOLDER = SHARED / "measured" / "emps"
TRAIN, PULSES = FOLDER / "DATA_EMPS.mat", FOLDER / "DATA_EMPS_PULSES.mat"
pytestmark = pytest.mark.skipif(not PULSES.exists(), reason="the measured data are elsewhere")


def test_the_published_model_explains_the_force_on_the_pulses():
    tool = load_tool("emps_errors")
    assert tool.force_residual(PULSES, tool.PUBLISHED) == pytest.approx(0.044, abs=0.001)
    without_friction = replace(tool.PUBLISHED, friction=0.0, offset=0.0)
    assert tool.force_residual(PULSES, without_friction) > 0.2


@pytest.mark.parametrize("time_factor", [1.0, 10.0])
def test_the_axis_is_the_same_at_another_time_scale(time_factor):
    emps, errors = load_tool("emps"), load_tool("emps_errors")
    geometry = geometry_from_dict(emps.geometry_content(time_factor))
    model = identify(measured_spectra([], geometry), geometry, IdentifyOptions(method="computed"))
    axis = errors.identified_axis(model, time_factor)
    assert axis.mass == pytest.approx(emps.DECLARED_MASS)
    assert axis.viscous == pytest.approx(2 * 0.5 * np.sqrt(emps.STIFFNESS * emps.DECLARED_MASS))
    run = emps.emps_run("train", TRAIN, time_factor)
    block = run.read()
    assert run.sample_rate == 1000.0 * time_factor
    # What is left of the load without the spring is the force of the drive, as large as its friction at least.
    assert np.abs(block.loads[:, 0] - block.channels[:, 0]).max() > 20.0


@cache
def spectra_and_geometry(time_factor):
    emps = load_tool("emps")
    geometry = geometry_from_dict(emps.geometry_content(time_factor))
    return measured_spectra([emps.emps_run("train", TRAIN, time_factor)], geometry, means=True), geometry


def check_axis(model, time_factor):
    """Friction and offset are the published ones; on the pulses the published model leaves 4.41 % of the force."""
    errors = load_tool("emps_errors")
    axis = errors.identified_axis(model, time_factor)
    (friction,) = (effect for effect in identified_effects(model) if effect.name == "dry-friction")
    force = friction.parameters[0]
    assert abs(force.value - errors.PUBLISHED.friction) < min(2.0 * force.sigma, 0.1 * errors.PUBLISHED.friction)
    assert axis.offset == pytest.approx(errors.PUBLISHED.offset, abs=0.02)
    assert axis.mass == pytest.approx(errors.PUBLISHED.mass, rel=0.01)
    assert errors.force_residual(PULSES, axis) < 0.045


@pytest.mark.parametrize("time_factor", [1.0, 10.0])
def test_friction_and_offset_are_the_published_ones(time_factor):
    spectra, geometry = spectra_and_geometry(time_factor)
    check_axis(identify(spectra, add_effects(geometry, ("load-offset@Fx", "dry-friction@x"))), time_factor)


def test_the_diagnosis_finds_both():
    spectra, geometry = spectra_and_geometry(1.0)
    diagnosis, updated = diagnose(identify(spectra, geometry), spectra)
    names = {effect.name for effect in diagnosis.effects}
    assert diagnosis.verdict == EXPLAINED and "dry-friction" in names
    assert names in ({"dry-friction", "load-offset"}, {"dry-friction", "channel-offset"})
    check_axis(updated, 1.0)
