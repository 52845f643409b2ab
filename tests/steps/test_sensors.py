"""Sums of cells and accelerometers from the sweeps to the loads: fits, intervals, and the filter in time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import geometry_from_dict, geometry_to_dict
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.io.errors import UserError
from balance_cli.reduction.model_sources import model_source
from balance_cli.simulation import draw_rig, simulate_campaign
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce import reduce_run
from tests.model.test_sensors import equipped_hexapod
from tests.support.other_rigs import short_campaign
from tests.support.truth import true_parameters


def _without_own_channels(cells: tuple[str, ...]) -> Geometry:
    content = geometry_to_dict(equipped_hexapod())
    content["channels"] = [channel for channel in content["channels"] if channel.get("cell") not in cells]
    return geometry_from_dict(content)


@pytest.fixture(scope="module", params=["all legs", "three legs"])
def fitted(request: pytest.FixtureRequest):
    geometry = equipped_hexapod() if request.param == "all legs" else _without_own_channels(("l1", "l3", "l5"))
    rig = draw_rig(geometry, np.random.default_rng(3))
    rig = replace(rig, damping_ratios=np.maximum(rig.damping_ratios, 0.004))
    campaign = simulate_campaign(rig, short_campaign("A", sweeps=30.0, revolutions=100), seed=3)
    return rig, campaign, identify(measured_spectra(campaign.runs, geometry), geometry)


def test_parameters_are_within_their_sigma(fitted):
    rig, _, model = fitted
    table = model.parameters
    known = table.sigma > 0
    z = (table.value - true_parameters(rig, table))[known] / table.sigma[known]
    assert np.abs(z).max() < 4.0
    assert 0.4 < model.quality.chi2_per_dof < 1.2


def test_harmonic_loads_are_within_their_sigma_and_no_row_is_suspect(fitted):
    rig, campaign, model = fitted
    calibration = calibrate([run for run in campaign.runs if run.kind == "static"], rig.geometry)
    for run, truth in zip(campaign.runs, campaign.truths, strict=True):
        if run.kind not in ("check", "wind"):
            continue
        loads = reduce_run(run, rig.geometry, calibration, model_source(model), None)
        true = (truth.cosine - 1j * truth.sine)[: len(loads.amplitude)]
        error = (loads.amplitude - true)[1:]
        z = np.stack([error.real / loads.sigma_cosine[1:], error.imag / loads.sigma_sine[1:]])
        assert np.mean(np.abs(z) < 1.96) > 0.88
        assert not any("redundancy" in word or "model" in word for row in loads.flags[1:] for word in row)


def test_least_squares_say_what_they_lack():
    """Two legs in one sum and no channel else: the motion is not determined by forces."""
    geometry = _without_own_channels(("l1", "l2", "l3", "l4", "l5"))
    campaign = simulate_campaign(draw_rig(geometry, np.random.default_rng(1)), short_campaign("A", sweeps=12.0), seed=1)
    spectra = measured_spectra([run for run in campaign.runs if run.kind == "sweep"], geometry)
    with pytest.raises(UserError, match="determine every motion"):
        identify(spectra, geometry, IdentifyOptions(method="ls"))
