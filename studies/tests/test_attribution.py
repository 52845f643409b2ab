"""The study of attribution: what it hides, and how it counts."""

from collections import Counter

import numpy as np
import pandas as pd
import pytest

from balance_cli.diagnosis.result import Evidence, FoundEffect
from balance_cli.simulation import true_rig
from balance_cli.simulation.assembly import equations_of_motion
from studies import chunks
from studies.attribution import is_attributed
from studies.attribution_tables import attribution_table
from studies.cases import EXCITATIONS, KINDS, LARGE_SIZES, PAIRS, PLACES, SIZES, case, count
from studies.sizing import power
from studies.unknown import unknown_effect
from tests.support.rigs import rotor_balance
from tests.support.unknown_effects import SaturatingChannel, TunedMass

EVIDENCE = Evidence(gain=50.0, parameters=1, p_value=1e-6, score=50.0, cross_validation_gain=40.0, round=1)


def found(label, *alike):
    name, _, where = label.partition("@")
    return FoundEffect(name, tuple(where.split(",")) if where else (), (), EVIDENCE, alike)


def test_every_effect_is_hidden_at_least_ten_times_in_all_sizes_with_each_excitation():
    cases = [case("single", seed) for seed in range(count("single"))]
    names = Counter(one.hidden[0].partition("@")[0] for one in cases)
    assert set(names) == set(PLACES)
    assert min(names.values()) >= 10
    for name in PLACES:
        mine = [one for one in cases if one.hidden[0].partition("@")[0] == name]
        assert {one.excitation for one in mine} == set(EXCITATIONS)
        sizes = np.log([one.sizes[0] for one in mine])
        assert np.all((sizes >= np.log(SIZES[0])) & (sizes <= np.log(SIZES[1])))
        assert np.ptp(sizes) > 0.8 * np.ptp(np.log(SIZES))
        for excitation in EXCITATIONS:
            some = [np.log(one.sizes[0]) for one in mine if one.excitation == excitation]
            assert np.ptp(some) > 0.5 * np.ptp(np.log(SIZES))


def test_pairs_nothing_and_what_no_file_describes():
    assert len(set(PAIRS)) >= 15
    assert count("nothing") >= 300
    assert {case("unknown", seed).hidden for seed in range(count("unknown"))} == {
        ("tuned-mass",),
        ("saturating-channel",),
    }
    assert {case("untestable", seed).hidden[0] for seed in range(count("untestable"))} >= {"gyroscopic-coupling"}
    assert case("pair", 5) == case("pair", 5)
    assert len({case(kind, 3).rng.integers(2**31) for kind in KINDS}) == len(KINDS)


def test_every_effect_is_hidden_large_and_three_different_ones_together():
    large = [case("large", seed) for seed in range(count("large"))]
    assert {one.hidden[0].partition("@")[0] for one in large} == set(PLACES)
    assert {(one.hidden[0].partition("@")[0], one.excitation) for one in large} >= {("dry-friction", EXCITATIONS[0])}
    threes = [case("three", seed) for seed in range(count("three"))]
    assert all(len({label.partition("@")[0] for label in one.hidden}) == 3 for one in threes)
    sizes = [size for one in (*large, *threes) for size in one.sizes]
    assert SIZES[1] <= min(sizes) < max(sizes) <= LARGE_SIZES[1]
    assert min(size for one in large for size in one.sizes) >= LARGE_SIZES[0]


def test_right_is_what_is_hidden_and_nothing_else():
    late = "time-delay@x.piezo"
    assert is_attributed([found(late)], [late])
    assert is_attributed([found("low-pass@x.piezo", late)], [late])
    assert not is_attributed([found("low-pass@x.piezo")], [late])
    assert not is_attributed([found(late), found("channel-gain@torque")], [late])
    assert not is_attributed([], [late])
    assert is_attributed([], [])
    assert not is_attributed([found(late)], [])
    assert is_attributed([found("mast-bending@x")], ["mast-bending@x,y"])
    assert not is_attributed([found("mast-bending@x,y")], ["mast-bending@x"])
    # One found effect stands for one that is hidden.
    assert not is_attributed([found(late), found("channel-gain@torque", late)], [late, "added-mass"])


def test_no_test_has_more_power_than_chance_at_zero_and_all_of_it_far_off():
    assert power(0.0, 1, 400) == pytest.approx(0.003 / 400, rel=1e-6)
    assert 0.4 < power(25.0, 1, 400) < 0.9
    assert power(25.0, 6, 400) < power(25.0, 1, 400)
    assert power(1e3, 6, 400) > 0.999


def test_tuned_mass_leaves_what_is_at_rest_and_adds_a_mode():
    rig = true_rig(rotor_balance())
    mass = TunedMass(mass=1.0, frequency=50.0, position=(0.2, 0.1, 0.3), direction=(0.6, 0.0, 0.8))
    tuned = rig.with_extensions(mass)
    bare, with_it = equations_of_motion(rig), equations_of_motion(tuned)
    rest = [np.linalg.solve(one.total_stiffness(), one.loads) for one in (bare, with_it)]
    np.testing.assert_allclose(rest[1][: bare.size], rest[0], rtol=1e-12)
    np.testing.assert_allclose(rest[1][bare.size :], 0.0, atol=1e-18)
    # The energy of a rigid motion of all parts is that of the plate and of the mass along its direction alone.
    velocity = np.zeros(with_it.size)
    velocity[with_it.names.index("x")] = 1.0
    assert velocity @ with_it.mass @ velocity == pytest.approx(bare.mass[0, 0], rel=1e-12)
    assert np.all(np.linalg.eigvalsh(with_it.mass) > 0)


def test_unknown_effects_are_drawn_within_their_ranges():
    rng = np.random.default_rng(0)
    names = rotor_balance().channel_names
    masses = [unknown_effect("tuned-mass", names, rng) for _ in range(20)]
    assert all(isinstance(one, TunedMass) and 0.1 <= one.mass <= 2.0 for one in masses)
    bent = [unknown_effect("saturating-channel", names, rng) for _ in range(20)]
    assert all(isinstance(one, SaturatingChannel) and one.where[0] in names for one in bent)
    assert all(0.0005 < 1 - one.limit * np.tanh(2.0 / one.limit) / 2.0 < 0.03 for one in bent)


def test_table_counts_detected_right_and_covered():
    row = {
        "kind": "single",
        "hidden": "time-delay@x.piezo",
        "excitation": "random",
        "possible": 0.9,
        "by_set": False,
        "set_size": 1.0,
        "chi2_before": 1.1,
        "chi2_after": 1.0,
        "load_error_before": 0.02,
        "load_error_after": 0.01,
        "load_error_noise": 0.01,
    }
    rows = pd.DataFrame(
        [
            {**row, "detected": True, "right": True, "deviations": "0.5 -3.0"},
            {**row, "detected": True, "right": False, "deviations": ""},
            {**row, "detected": False, "right": False, "deviations": np.nan},
        ]
    )
    first = attribution_table(rows).iloc[0]
    assert first["campaigns"] == 3
    assert first["detected"] == pytest.approx(2 / 3)
    assert first["right"] == pytest.approx(1 / 3)
    assert first["right_of_detected"] == 0.5
    assert (first["parameters"], first["coverage_95"]) == (2, 0.5)


def _third_fails(seed):
    if seed == 2:
        raise ValueError("no such campaign")
    return pd.DataFrame({"seed": [seed]})


def test_a_study_keeps_what_did_not_fail_and_says_what_did(tmp_path, monkeypatch):
    monkeypatch.setattr(chunks, "CACHE", tmp_path)
    with pytest.raises(RuntimeError, match="some: 1 seeds failed, the first is 2") as caught:
        chunks.run_chunks("some", _third_fails, range(4), jobs=1)
    assert isinstance(caught.value.__cause__, ValueError)
    assert sorted(path.name for path in (tmp_path / "some").iterdir()) == ["00000.csv", "00001.csv", "00003.csv"]
    assert chunks.run_chunks("some", _third_fails, [0, 1, 3], jobs=1).seed.tolist() == [0, 1, 3]
