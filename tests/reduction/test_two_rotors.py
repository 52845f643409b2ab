"""Two rotors in one record: each is reduced by its own harmonics, and none of its lines counts for the other."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from balance_cli.campaign.recording.additions import RunAdditions
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.recording.run_file import write_run
from balance_cli.campaign.rig.geometry_file import save_geometry
from balance_cli.cli import balance
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.io.errors import UserError
from balance_cli.reduction.flags import UNMODELLED_LINE
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.signals.rotor.azimuth import azimuth_from_pulses
from balance_cli.signals.rotor.other_rotors import without_other_rotors
from balance_cli.simulation import NO_NOISE, RotorPlan, simulate_run, true_rig
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce import ReduceOptions, reduce_run
from tests.support.other_rigs import other_rig

SPEEDS = (22.0, 31.7)
HARMONICS = {"Fx": (20.0, 10.0, 5.0, 2.0), "Fz": (40.0, 20.0, 10.0, 5.0), "My": (4.0, 2.0, 1.0, 0.5)}


@cache
def two_rotor_run(speeds=SPEEDS, drift=0.02, seed=1) -> tuple[Run, list]:
    """Rig A with both rotors, each alone simulated and then added: the rig is linear."""
    rig = true_rig(other_rig("A"))
    plans = [
        RotorPlan(
            run="wind", kind="wind", harmonics=HARMONICS, sample_rate=2000.0, duration=12.0, rotor_speed=speed, drift=d
        )
        for speed, d in zip(speeds, (0.01, drift), strict=True)
    ]
    (first, truth), (second, other) = (simulate_run(rig, plan, NO_NOISE, seed + i) for i, plan in enumerate(plans))
    channels = first.read().channels + second.read().channels
    noise = 1e-3 * np.random.default_rng(seed).standard_normal(channels.shape)
    additions = RunAdditions(further_pulse_times=(second.pulse_times,))
    return replace(first, source=MemorySource(channels + noise, None), additions=additions), [truth, other]


@pytest.fixture(scope="module")
def source() -> ModelSource:
    return ModelSource(identify(Spectra((), (), (), {}), other_rig("A"), IdentifyOptions(method="computed")))


def relative_errors(loads, truth) -> np.ndarray:
    columns = [["Fx", "Fy", "Fz", "Mx", "My", "Mz"].index(name) for name in loads.components]
    true = (truth.cosine - 1j * truth.sine)[1:5, columns]
    driven = np.abs(true) > 0
    return (np.abs(loads.amplitude[1:5] - true) / np.where(driven, np.abs(true), 1.0))[driven]


@pytest.mark.parametrize("rotor", [1, 2])
def test_each_rotor_has_its_own_harmonics(source, rotor):
    run, truths = two_rotor_run()
    loads = reduce_run(run, other_rig("A"), None, source, None, ReduceOptions(8, rotor))
    assert loads.frequency_hz[1] == pytest.approx(SPEEDS[rotor - 1], rel=0.02)
    assert loads.rotor == (None if rotor == 1 else 2)
    assert np.median(relative_errors(loads, truths[rotor - 1])) < 0.002
    assert relative_errors(loads, truths[rotor - 1]).max() < 0.03
    assert not any(UNMODELLED_LINE in word for row in loads.flags for word in row)


def test_without_its_pulses_the_other_rotor_is_an_unmodelled_line(source):
    run, _ = two_rotor_run(drift=0.0)
    loads = reduce_run(replace(run, additions=None), other_rig("A"), None, source)
    known = reduce_run(run, other_rig("A"), None, source)
    flagged = np.array([[UNMODELLED_LINE in word for word in row] for row in loads.flags[1:]])
    departure = np.abs(loads.amplitude - known.amplitude)[1:] / known.sigma_cosine[1:]
    assert flagged.any()
    assert flagged[departure > 0.3].all()


def test_harmonics_that_coincide_are_flagged_and_named(source):
    """The second rotor turns three halves as fast, geared to the first: its 2/rev is 3/rev of the first."""
    run, _ = two_rotor_run((22.0, 33.0), drift=0.01)
    loads = reduce_run(run, other_rig("A"), None, source, None, ReduceOptions(8))
    flagged = [n for n, row in enumerate(loads.flags) if any(UNMODELLED_LINE in word for word in row)]
    assert flagged == [3, 6]
    assert any("3/rev cannot be told from 2/rev of rotor 2" in note for note in loads.notes)


def test_pulses_that_cover_a_part_of_the_record_are_refused(source):
    run, _ = two_rotor_run()
    pulses = run.additions.further_pulse_times[0]
    cut = replace(run, additions=RunAdditions(further_pulse_times=(pulses[pulses < 8.0],)))
    with pytest.raises(UserError, match="covers") as caught:
        reduce_run(cut, other_rig("A"), None, source)
    assert caught.value.place == "rotor2/pulse_times"
    with pytest.raises(UserError, match="no 1/rev pulses"):
        reduce_run(run, other_rig("A"), None, source, None, ReduceOptions(8, 3))


def test_a_record_of_one_rotor_is_left_as_it_is():
    run = replace(two_rotor_run()[0], additions=None)
    same, confounded = without_other_rotors(run, azimuth_from_pulses(run.pulse_times), 1, 8, 0)
    assert same is run and confounded == ()


def test_the_command_reduces_either_rotor(tmp_path):
    geometry, run = other_rig("A"), two_rotor_run()[0]
    save_geometry(tmp_path / "rig.yaml", geometry)
    write_run(tmp_path / "wind.h5", run)

    def call(*words):
        return CliRunner().invoke(balance, [str(word) for word in words])

    made = call("identify", "-g", tmp_path / "rig.yaml", "--method", "computed", "-o", tmp_path / "model.h5")
    assert made.exit_code == 0, made.output
    for rotor in (1, 2):
        words = ("--model", tmp_path / "model.h5", tmp_path / "wind.h5", "--rotor", rotor, "--harmonics", 3)
        result = call("reduce", *words, "-o", tmp_path / f"loads-{rotor}.csv", "--history", tmp_path / f"{rotor}")
        assert result.exit_code == 0, result.output
        table = pd.read_csv(tmp_path / f"loads-{rotor}.csv")
        assert table["frequency_hz"].max() == pytest.approx(3 * SPEEDS[rotor - 1], rel=0.03)
    refused = call("reduce", *words, "--method", "smoother", "-o", tmp_path / "loads.csv")
    assert refused.exit_code == 2 and "--rotor" in refused.output
