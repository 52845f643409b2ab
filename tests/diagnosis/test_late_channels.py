"""Channels that are late against the loads are found from the phases of their responses alone, all at once."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.rig_scales import rig_frequency
from balance_cli.diagnosis.search.late_channels import late_channels
from balance_cli.diagnosis.search.refit import fit_until_stable
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.diagnosis.search.whole_fits import add_all_by_whole_fit
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from tests.support.model_lines import model_lines
from tests.support.rigs import rotor_balance


def without_torque_meter():
    """The sample rig without its shaft, which no force moves."""
    content = rotor_balance().model_dump(mode="json", exclude_none=True)
    del content["torque_meter"]
    content["channels"] = [channel for channel in content["channels"] if channel["name"] != "torque"]
    return Geometry.model_validate(content)


RIG = without_torque_meter()
HALF = tuple(f"{cell}.{kind}" for cell in ("x", "y1", "y2", "z1") for kind in ("strain", "piezo"))
PERIOD = 1.0 / rig_frequency(RIG)


def sweeps(delays):
    """Sweeps of a rig whose damping and stiffness are not those declared; `delays` [s] by channel."""
    model, rng = balance_model(RIG), np.random.default_rng(8)
    other = balance_model(RIG.model_copy(update={"damping_ratio": 2.0 * RIG.damping_ratio}))
    frequency = np.arange(5.0, 150.0, 0.5)
    runs = [model_lines(other, name, i, frequency, 1e-3, rng) for i, name in enumerate(("Fx", "Fy", "Fz", "Mx", "My"))]
    late = np.array([delays.get(name, 0.0) for name in model.geometry.channel_names])
    turn = np.exp(-2j * np.pi * frequency[:, None] * late)
    return [replace(run, channels=run.channels * turn) for run in runs]


@pytest.mark.parametrize("periods", [0.1, -0.1, 0.5, 2.0])
def test_half_of_the_channels_on_one_late_box_are_found(periods):
    """At two periods of the modes a fit from zero is many turns of phase away."""
    delay = periods * PERIOD
    found = late_channels(sweeps(dict.fromkeys(HALF, delay)), RIG, SETTINGS)
    assert {item.placed_effect.where for item in found} == {(name,) for name in HALF}
    assert [item.starts[0]["delay"] for item in found] == pytest.approx([delay] * len(HALF), abs=0.05 * PERIOD)


def test_a_group_that_is_late_is_one_candidate():
    strain = [name for name in RIG.channel_names if name.endswith("strain")]
    found = late_channels(sweeps(dict.fromkeys([*strain, "x.piezo"], 0.3 * PERIOD)), RIG, SETTINGS)
    assert [item.label for item in found] == ["time-delay@strain", "time-delay@x.piezo"]


def test_channels_in_time_are_not_late():
    assert late_channels(sweeps({}), RIG, SETTINGS) == ()
    assert late_channels(sweeps(dict.fromkeys(HALF, PERIOD)), RIG, replace(SETTINGS, excluded=("time-delay",))) == ()


def test_all_of_them_are_fitted_at_once():
    """One after another they took eight rounds, and a minute of computing."""
    delay = 0.1 * PERIOD
    runs = sweeps(dict.fromkeys(HALF, delay))
    batches = stack_runs([run.select(np.arange(len(run.frequency)) % 5 == 0) for run in runs], (), RIG.channel_names)
    lines = SearchLines(batches, batches)
    model = balance_model(RIG)
    state = fit_until_stable(model.at(), lines, SETTINGS.fit)
    found, trials, gains = add_all_by_whole_fit(state, late_channels(runs, RIG, SETTINGS), lines, SETTINGS)
    assert found.error < 3e-3 < SETTINGS.rounds.stuck_error < state.error
    assert set(gains) == {trial.label for trial in trials} == {f"time-delay@{name}" for name in HALF}
    fitted = dict(zip(found.model.parameters.names, found.theta.tolist(), strict=True))
    assert [fitted[f"time-delay@{name}.delay"] for name in HALF] == pytest.approx([delay] * len(HALF), rel=0.01)
    assert add_all_by_whole_fit(found, late_channels(runs, RIG, SETTINGS), lines, SETTINGS) == (found, (), {})
