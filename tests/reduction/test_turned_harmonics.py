"""Wind runs with the pulses of another edge, or all channels reversed, are named beside a run like them; no others."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import balance_cli as bal
from balance_cli.campaign.recording.run import MemorySource
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.reduction.result import RunLoads
from balance_cli.reduction.turned_harmonics import common_turn, compare_wind_runs, flag_turned_runs, turn_warnings

ROOT = Path(__file__).parents[2]
COUNT = 9


def a_run(amplitude, name="wind-1"):
    return RunLoads(
        run=name,
        kind="wind",
        response="model",
        trim="bare",
        components=COMPONENTS,
        frequency_hz=17.5 * np.arange(COUNT),
        amplitude=amplitude,
        sigma_cosine=np.full((COUNT, 6), 0.01),
        sigma_sine=np.full((COUNT, 6), 0.01),
        flags=(("",) * 6,) * COUNT,
        redundancy=np.ones(COUNT),
        redundancy_limit=np.full(COUNT, 3.0),
        condition=np.ones(COUNT),
        left_out={},
        interval=(0.0, 10.0),
    )


def warnings_of(runs):
    return list(turn_warnings(compare_wind_runs({run.run: run for run in runs})))


def is_reversed(before, after):
    (comparison,) = compare_wind_runs({"wind-1": before, "wind-2": after})
    return comparison.sign < 0


def flagged_harmonics(runs):
    """First flagged harmonic of each run that has a flag, through the comparison of the runs."""
    by_name = {run.run: run for run in runs}
    flagged = flag_turned_runs(by_name, compare_wind_runs(by_name))
    words = {name: ["model contradicted" in row[0] for row in run.flags] for name, run in flagged.items()}
    return {name: rows.index(True) for name, rows in words.items() if any(rows)}


def random_loads(rng):
    normal = rng.standard_normal((COUNT, 6)) + 1j * rng.standard_normal((COUNT, 6))
    return normal * np.geomspace(10.0, 1.0, COUNT)[:, None]


def changed(loads, share, turn, rng):
    """Loads that differ by a share of their size, with pulses that come `turn` degrees late."""
    noise = (rng.standard_normal(loads.shape) + 1j * rng.standard_normal(loads.shape)) / np.sqrt(2.0)
    other = loads + share * np.abs(loads) * noise
    # x = Re(a exp(j n psi)), and psi counts from a later moment.
    return other * np.exp(1j * np.radians(turn) * np.arange(COUNT))[:, None]


@pytest.mark.parametrize("turn", [10.0, -20.0, 45.0])
def test_the_turn_of_runs_that_differ_by_a_fifth(turn):
    rng = np.random.default_rng(1)
    turns = []
    for _ in range(20):
        loads = random_loads(rng)
        turns.append(common_turn(a_run(loads), a_run(changed(loads, 0.2, turn, rng), "wind-2")))
    assert np.allclose(np.array(turns, float), turn, atol=1.5)


def test_one_run_of_another_edge_is_named_and_the_return_from_it():
    rng = np.random.default_rng(2)
    loads = random_loads(rng)
    runs = [a_run(changed(loads, 0.1, turn, rng), f"wind-{k}") for k, turn in enumerate((0.0, 10.0, 0.0))]
    said = warnings_of(runs)
    assert [text.partition(":")[0] for text in said] == ["wind-1", "wind-2"]
    assert re.search(r"those of wind-0 turned by n times \+(9\.|10)", said[0]) and "n times -" in said[1]
    assert flagged_harmonics(runs) == {"wind-1": 1}
    assert flagged_harmonics(runs[:2]) == {"wind-0": 1, "wind-1": 1}  # either may be the right one


def test_neither_repeated_points_nor_other_loads_nor_one_harmonic_are_turned():
    rng = np.random.default_rng(3)
    loads = [random_loads(rng) for _ in range(60)]
    assert not list(warnings_of(a_run(item, f"wind-{k}") for k, item in enumerate(loads)))
    assert not list(warnings_of(a_run(changed(loads[0], 0.3, 0.0, rng), f"wind-{k}") for k in range(60)))
    first, second = np.zeros((2, COUNT, 6), complex)
    first[1], second[1] = 1.0, 1j  # two phases of 1/rev are as many loads
    assert common_turn(a_run(first), a_run(second)) is None


def test_of_equal_angles_of_a_rotor_with_eight_blades_the_smallest_is_meant():
    loads = np.zeros((33, 6), complex)
    loads[8::8] = random_loads(np.random.default_rng(4))[:4]
    sigma = np.full(loads.shape, 0.01)
    run = replace(a_run(loads), sigma_cosine=sigma, sigma_sine=sigma)
    assert common_turn(run, run) == 0.0


def test_harmonics_of_the_opposite_sign_are_no_turn_but_reversed_channels():
    rng = np.random.default_rng(5)
    loads = random_loads(rng)
    runs = [a_run(sign * changed(loads, 0.2, 0.0, rng), f"wind-{k}") for k, sign in enumerate((1, -1, -1, 1))]
    assert [text.partition(":")[0] for text in warnings_of(runs)] == ["wind-1", "wind-3"]
    assert all("opposite sign" in text for text in warnings_of(runs))
    assert flagged_harmonics(runs[1:]) == {"wind-3": 0}
    assert set(flagged_harmonics(runs)) == {"wind-0", "wind-1", "wind-2", "wind-3"}
    no_mean = [replace(run, amplitude=np.vstack([np.full((1, 6), np.nan), run.amplitude[1:]])) for run in runs]
    assert is_reversed(*no_mean[:2])
    even = np.exp(1j * np.pi * np.arange(COUNT))[:, None]  # half a revolution: even harmonics keep their sign
    assert not is_reversed(a_run(loads), a_run(loads * even))


def test_mean_loads_of_the_opposite_sign_tell_only_where_harmonics_do_not():
    rng = np.random.default_rng(6)
    loads, other = random_loads(rng), random_loads(rng)
    other[0] = -loads[0]
    assert is_reversed(a_run(loads), a_run(other))
    assert not is_reversed(a_run(loads), a_run(np.vstack([-loads[:1], loads[1:]])))
    unclear = replace(a_run(other), sigma_cosine=np.full((COUNT, 6), 100.0))
    assert not is_reversed(a_run(loads), unclear)


def test_a_measured_wind_run_with_all_channels_reversed_is_named_and_sound_ones_are_not():
    geometry = bal.read_geometry(ROOT / "configs/rts-6.yaml")
    calibration = bal.calibrate(ROOT / "sample_data/static-bare.h5", geometry)
    first, second, third = (bal.read_run(ROOT / f"sample_data/wind-{k}.h5") for k in (1, 2, 3))
    source = MemorySource(-second.read().channels, None)
    runs = [first, second, replace(second, name="wind-4", source=source), third]
    loads = bal.reduce(runs, calibration, "static", harmonics=3)
    assert not warnings_of(run for name, run in loads.runs.items() if name != "wind-4")
    said = [text for text in loads.warnings or () if "opposite sign" in text]
    assert [text.partition(" with")[0] for text in said] == ["wind-4: its loads are those of wind-3"]
    assert [name for name, run in loads.runs.items() if "model contradicted" in run.flags[0][0]] == ["wind-4"]
