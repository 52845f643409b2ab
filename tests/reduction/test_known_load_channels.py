"""Channels that the known loads of a check run contradict, on a balance without redundant channels."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.reduction.model_sources import model_source
from balance_cli.simulation import simulate_campaign, true_rig
from balance_cli.steps.contradicted_loads import compare_loads
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce import reduce_run
from tests.support.other_rigs import other_rig, short_campaign

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def campaign():
    geometry = load_geometry(ROOT / "configs" / "hexapod.yaml")
    plan = short_campaign("A", revolutions=60)  # of a rig of this size
    plan = plan.model_copy(update={"runs": tuple(run for run in plan.runs if run.run in ("check-2", "wind-1"))})
    runs = {run.name: run for run in simulate_campaign(true_rig(geometry), plan, seed=1).runs}
    return (
        geometry,
        model_source(identify(measured_spectra([], geometry), geometry, IdentifyOptions(method="computed"))),
        runs,
    )


def reduced(campaign, change):
    """Loads and warnings of a wind run and of a check run whose channels were changed."""
    geometry, source, runs = campaign
    block = runs["check-2"].read()
    channels = block.channels.copy()
    change(channels)
    check = replace(runs["check-2"], source=MemorySource(channels, block.loads))
    loads = {run.name: reduce_run(run, geometry, None, source) for run in (check, runs["wind-1"])}
    return compare_loads(loads, None)


def scale(index, factor):
    def change(channels):
        channels[:, index] *= factor

    return change


def exchange(first, second):
    def change(channels):
        channels[:, [first, second]] = channels[:, [second, first]]

    return change


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (scale(0, -1.0), "{0} is reversed"),
        (scale(2, 1e3), "{2} reads 1000 times what the known loads make"),
        (scale(2, 1e-3), "{2} reads 0.001 times what the known loads make"),
        (scale(4, 2.0), "{4} reads 2 times what the known loads make"),
        (scale(4, -3.0), "{4} is reversed, and reads 3 times what the known loads make"),
        (exchange(0, 3), "{0} and {3} are exchanged"),
    ],
)
def test_a_wrong_channel_is_named_and_all_loads_are_flagged(campaign, change, named):
    loads, warnings = reduced(campaign, change)
    names = campaign[2]["check-2"].channel_names
    assert len(warnings) == 1 and named.format(*names) in warnings[0].replace("1e+03", "1000")
    for run in loads.values():
        assert all("model contradicted" in flag for row in run.flags for flag in row)


def test_a_sound_run_has_no_wrong_channel(campaign):
    loads, warnings = reduced(campaign, lambda channels: None)
    assert warnings == () and loads["check-2"].check.wrong_channels is None


@pytest.mark.parametrize("change", [scale(slice(None), 1e3), scale([0, 1, 2], 2.0)])
def test_most_channels_are_not_the_exception(campaign, change):
    loads, warnings = reduced(campaign, change)
    assert loads["check-2"].check.wrong_channels is None and "the response lacks something" in warnings[0]


def test_noise_alone_explains_nothing(campaign):
    rng = np.random.default_rng(3)

    def change(channels):
        channels[:, 1] = rng.standard_normal(len(channels))

    loads, _ = reduced(campaign, change)
    assert loads["check-2"].check.wrong_channels is None


@pytest.mark.parametrize(
    ("matrix", "named"),
    [
        (np.eye(6)[[0, 3, 2, 1, 4, 5]], "the channels of cell l2 and those of cell l4 are exchanged"),
        (np.diag([1.0, 1.0, 1.0, 1.0, -1.0, 1.0]), "the channels of cell l5 are reversed"),
    ],
)
def test_all_channels_of_a_cell_are_wrong_together(matrix, named):
    geometry = other_rig("A")
    plan = short_campaign("A", revolutions=60)
    plan = plan.model_copy(update={"runs": tuple(run for run in plan.runs if run.run == "check-1")})
    check = simulate_campaign(true_rig(geometry), plan, seed=1).runs[0]
    source = model_source(identify(measured_spectra([], geometry), geometry, IdentifyOptions(method="computed")))
    block = check.read()
    wrong = replace(check, source=MemorySource(block.channels @ np.kron(np.eye(2), matrix), block.loads))
    for run, words in ((check, None), (wrong, named)):
        loads = reduce_run(run, geometry, None, source)
        assert loads.check is not None
        assert loads.check.wrong_channels == words
