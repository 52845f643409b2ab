"""A balance with as many sensors as loads: turbulence between the harmonics shows mistakes in its channels."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.reduction.flags import MODEL_CONTRADICTED
from balance_cli.simulation import draw_rig, simulate_campaign
from balance_cli.steps.reduce import reduce_run
from tests.reduction.test_suspect_channels import HEXAPOD, computed
from tests.support.other_rigs import short_campaign


def simulated_wind(turbulence):
    """A wind run of 60 revolutions of the hexapod as declared, integrated in time; turbulence by its size."""
    plan = short_campaign("A", revolutions=60)
    wind = next(run for run in plan.runs if run.run == "wind-1")
    size = {name: turbulence * value for name, value in wind.turbulence.items()}
    wind = wind.model_copy(update={"turbulence": {name: value for name, value in size.items() if value}})
    rig = draw_rig(computed(HEXAPOD)[0], np.random.default_rng(1))
    return simulate_campaign(rig, plan.model_copy(update={"runs": (wind,)}), seed=1).runs[0]


@pytest.fixture(scope="module")
def gusty():
    """A record with turbulence."""
    return simulated_wind(1.0)


@pytest.fixture(scope="module")
def calm():
    """A record without turbulence."""
    return simulated_wind(0.0)


def with_matrix(run, places):
    """The run whose channels (n, 6) of each kind are multiplied by what `places` returns of the identity (6, 6)."""
    volts = run.read().channels
    matrix = np.kron(np.eye(2), places(np.eye(6)))
    return replace(run, source=MemorySource(volts @ matrix.T, None))


def swap_legs(matrix):
    """The second and the fourth leg."""
    return matrix[[0, 3, 2, 1, 4, 5]]


def scaled(factor):
    """The fifth leg."""
    return lambda matrix: np.diag([1.0, 1.0, 1.0, 1.0, factor, 1.0]) @ matrix


def reduced(run):
    """The loads by the response of the rig as declared."""
    geometry, source = computed(HEXAPOD)
    return reduce_run(run, geometry, None, source)


@pytest.mark.parametrize(
    ("mistake", "name"),
    [
        (swap_legs, "the channels of cell l2 and those of cell l4 are exchanged"),
        (scaled(-1.0), "the channels of cell l5 are reversed"),
        (scaled(0.5), "the channels of cell l5 read 0.5 times what the other channels say"),
    ],
)
def test_a_mistake_in_the_channels_of_cells_without_redundancy_is_named(gusty, mistake, name):
    loads = reduced(with_matrix(gusty, mistake))
    assert loads.wrong_channels == name
    assert any(name in note for note in loads.notes)
    assert all(MODEL_CONTRADICTED in flag for row in loads.flags for flag in row)


def test_nothing_is_named_in_a_sound_record(gusty):
    loads = reduced(gusty)
    assert loads.wrong_channels is None
    assert not any(MODEL_CONTRADICTED in flag for row in loads.flags for flag in row)


def test_noise_alone_names_nothing(calm):
    for mistake in (lambda matrix: matrix, swap_legs, scaled(-1.0)):
        assert reduced(with_matrix(calm, mistake)).wrong_channels is None
