"""A cutting force that moves along a path: hub loads by a balance without rotor, against those applied."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.api.artefacts import load_artefact
from balance_cli.campaign.recording.additions import FORCE, POSITION, LoadPoints, MemoryAdditions, RunAdditions
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.recording.run_file import write_run
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.cli import balance
from balance_cli.simulation.replay import replay_loads
from balance_cli.simulation.rig import true_rig

CONFIG = Path(__file__).parents[2] / "configs" / "dynamometer.yaml"
RATE, SAMPLES = 4096.0, 3 * 4096
DIRECTIONS = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
NOISE = 1.5e-3
"""Standard deviation of a sample of a channel [V]."""


def call(*words):
    result = CliRunner().invoke(balance, [str(word) for word in words])
    assert result.exit_code == 0, result.output


@pytest.fixture(scope="module")
def reduced(tmp_path_factory):
    """Errors of the hub loads that move, and those of the same record that states the mean position instead."""
    folder = tmp_path_factory.mktemp("moving")
    geometry, rng = load_geometry(CONFIG), np.random.default_rng(1)
    share = np.arange(SAMPLES) / SAMPLES
    path = np.stack([0.16 * share - 0.08, 0.05 * np.sin(2 * np.pi * share), np.full(SAMPLES, 0.06)], axis=1)
    position = np.repeat(path[:, None, :], 2, axis=1)
    tooth = sum(
        a * np.cos(2 * np.pi * 66.7 * k * share * SAMPLES / RATE + k) for k, a in ((1, 40.0), (2, 20.0), (5, 5.0))
    )
    force = np.stack([tooth, 0.5 * tooth], axis=1) * np.clip(share / 0.1, 0, 1)[:, None]
    vectors = force[:, :, None] * DIRECTIONS
    hub = np.hstack([vectors.sum(axis=1), np.cross(position - np.array(geometry.hub), vectors).sum(axis=1)])
    volts = replay_loads(true_rig(geometry), hub, "check", RATE)
    volts = volts + NOISE * rng.standard_normal(volts.shape)
    call("identify", "-g", CONFIG, "--method", "computed", "-o", folder / "model.h5")
    moving = RunAdditions(
        LoadPoints(("feed", "plunge"), DIRECTIONS, None), source=MemoryAdditions({FORCE: force, POSITION: position})
    )
    fixed = replace(moving, load_points=replace(moving.load_points, position=position.mean(axis=0)))
    for name, additions in (("moving", moving), ("fixed", fixed)):
        run = Run(
            *(name, geometry.rig, "check", geometry.channel_names, SAMPLES, MemorySource(volts, None), False),
            sample_rate=RATE,
            additions=additions,
        )
        write_run(folder / f"{name}.h5", run, run.blocks(4096))
    runs = [folder / f"{name}.h5" for name in ("moving", "fixed")]
    call("reduce", "--model", folder / "model.h5", *runs, "--band", 20, 900, "-o", folder / "spectra.h5")
    return load_artefact(folder / "spectra.h5").runs


def test_loads_of_a_moving_force_are_those_about_the_hub(reduced):
    error = reduced["moving"].load_error
    assert max(error[name] for name in ("Fx", "Fz")) < 0.01
    assert max(error[name] for name in ("Mx", "My", "Mz")) < 0.03
    assert reduced["moving"].trust == "good"


def test_a_path_that_is_not_stated_shows_in_the_moments(reduced):
    assert max(reduced["fixed"].load_error[name] for name in ("Mx", "My", "Mz")) > 0.2
