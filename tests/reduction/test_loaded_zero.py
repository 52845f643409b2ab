"""A wind run that is given as the zero is named and not used; records without load are zeros, a hub may turn."""

from dataclasses import replace

import numpy as np
import pytest

import balance_cli as bal
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.reduction.flags import NO_ZERO
from balance_cli.simulation import draw_rig, simulate_campaign
from balance_cli.simulation.plans import RotorPlan
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduction_inputs import loaded_zero_warning
from tests.support.other_rigs import RIGS, other_rig, short_campaign


@pytest.fixture(scope="module", params=RIGS)
def day(request):
    """Runs and mean loads of a rig: statics, a zero, wind runs, one faster, and a hub that turns unloaded."""
    plan = short_campaign(request.param, revolutions=60)
    by_name = {run.run: run for run in plan.runs}
    wind = by_name["wind-1"]
    hub = {
        "run": "hub",
        "kind": "wind",
        "sample_rate": wind.sample_rate,
        "duration": 30.5 / wind.rotor_speed,
        "harmonics": {name: (2.0 * wind.harmonics[name][0], 0.01 * wind.harmonics[name][1]) for name in ("Fx", "Fy")},
    }
    runs = (
        *(by_name[name] for name in ("static-bare", "static-trim", "zero", "check-1", "wind-1")),
        wind.model_copy(update={"run": "wind-2"}),
        RotorPlan(**{**wind.model_dump(), "run": "faster", "rotor_speed": 1.2 * wind.rotor_speed}),
        RotorPlan(**hub, rotor_speed=wind.rotor_speed),
    )
    rig = draw_rig(other_rig(request.param), np.random.default_rng(4))
    simulated = simulate_campaign(rig, plan.model_copy(update={"runs": runs}), seed=4)
    named = {run.name: (run, truth) for run, truth in zip(simulated.runs, simulated.truths, strict=True)}
    return {**named, "geometry": other_rig(request.param)}


def as_zero(day, name, pulses=False):
    """A record given as the zero, with its pulses or as one at rest."""
    run = replace(day[name][0], kind="zero")
    return run if pulses else replace(run, pulse_times=None, rotor_speed=0.0)


@pytest.mark.parametrize("name", ["wind-2", "faster"])
@pytest.mark.parametrize("pulses", [False, True])
def test_a_wind_run_is_no_zero(day, name, pulses):
    zero = replace(as_zero(day, name, pulses), name="z")
    warning = loaded_zero_warning([zero], day["wind-1"][0])
    assert warning.startswith("z is no wind-off record and is not used")
    assert "of the amplitudes of wind-1" in warning


@pytest.mark.parametrize("record", ["wind-1", "check-1", "faster"])
def test_records_without_load_are_zeros(day, record):
    other = day[record][0]
    hubs = (as_zero(day, "hub", pulses) for pulses in (False, True))
    assert [loaded_zero_warning([zero], other) for zero in (day["zero"][0], *hubs)] == ["", "", ""]
    noise = np.random.default_rng(1).standard_normal
    quiet = day["zero"][0]
    samples = quiet.read()
    louder = samples.channels + 1.7 * samples.channels.std(axis=0) * noise(samples.channels.shape)
    source = replace(quiet.source, channels=louder)
    assert loaded_zero_warning([replace(quiet, source=source)], other) == ""


def test_mean_loads_do_not_count_from_a_wind_run(day):
    geometry = day["geometry"]
    calibration = calibrate([day[name][0] for name in ("static-bare", "static-trim")], geometry)
    model = identify(Spectra((), (), {}, {}), geometry, IdentifyOptions(method="computed"))
    (wind, truth), loaded = day["wind-1"], replace(as_zero(day, "wind-2"), name="z")
    found = bal.reduce([wind, loaded], calibration, model)
    assert any(text.startswith("z is no wind-off record") for text in found.warnings)
    loads = found.runs["wind-1"]
    assert all(NO_ZERO in flag for flag in loads.flags[0])
    error = np.abs(loads.amplitude[0].real - truth.cosine[0]) / loads.sigma_cosine[0]
    assert np.all(error < 4.0)
    sound = bal.reduce([wind, day["zero"][0]], calibration, model)
    assert not any(NO_ZERO in flag for flag in sound.runs["wind-1"].flags[0])
