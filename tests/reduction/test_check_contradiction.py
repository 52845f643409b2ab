"""Known loads of a check run contradict the response, for the wind runs of the same call, too."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.reduction.check_contradiction import contradicted_components, flag_by_check_runs
from balance_cli.reduction.check_errors import scale_contradiction
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.result import CheckErrors
from balance_cli.steps.contradicted_loads import compare_loads, compare_with_other_runs
from balance_cli.steps.reduce import reduce_run


@pytest.fixture(scope="module")
def loads(campaign, calibration, identified):
    source = model_source(identified)
    runs = [campaign.runs_of_kind(kind)[0] for kind in ("check", "wind")]
    return {run.name: reduce_run(run, campaign.geometry, calibration, source) for run in runs}


def _with_error(loads, component, share, harmonics):
    """The check run with an error of one component at some harmonics, as a share of the known load."""
    check = next(iter(loads.values()))
    m = check.components.index(component)
    amplitude = check.amplitude.copy()
    amplitude[harmonics, m] = (1.0 + share) * check.check.applied[harmonics, m]
    error, size = amplitude[1:9, m] - check.check.applied[1:9, m], check.check.applied[1:9, m]
    relative = float(np.linalg.norm(error) / np.linalg.norm(size))
    wrong = replace(
        check,
        amplitude=amplitude,
        check=replace(check.check, load_error={**check.check.load_error, component: relative}),
    )
    return {**loads, check.run: wrong}


def _flagged(loads):
    return {
        (run.kind, component)
        for run in loads.values()
        for row in run.flags
        for component, flag in zip(run.components, row, strict=True)
        if "model contradicted" in flag
    }


def test_sound_runs_stay_as_they_are(loads):
    assert flag_by_check_runs(loads) == (loads, ())


def test_a_component_that_is_wrong_is_flagged_in_all_runs(loads):
    flagged, found = flag_by_check_runs(_with_error(loads, "Fz", 0.3, slice(1, None)))
    assert _flagged(flagged) == {("check", "Fz"), ("wind", "Fz")}
    assert found[0].components["Fz"] == pytest.approx(0.3, abs=0.01)
    assert all("Fz by 30 %" in run.notes[-1] for run in flagged.values())
    assert not any("contradicted" in flag for run in flagged.values() for flag in run.flags[0])


def test_runs_of_other_shards_are_flagged_when_the_shards_are_merged(loads):
    wrong = _with_error(loads, "Fz", 0.3, slice(1, None))
    shards = {name: compare_loads({name: run}, None, is_shard=True)[0][name] for name, run in wrong.items()}
    assert all(shards[name] is run for name, run in wrong.items())
    merged, once = compare_with_other_runs(shards), compare_loads(wrong, None)
    assert merged[1] == once[1]
    assert _flagged(merged[0]) == _flagged(once[0]) == {("check", "Fz"), ("wind", "Fz")}


def test_a_single_harmonic_is_flagged_in_the_check_run_alone(loads):
    flagged, found = flag_by_check_runs(_with_error(loads, "Fz", 0.05, slice(4, 5)))
    assert (_flagged(flagged), found) == ({("check", "Fz")}, ())
    (check, _) = flagged.values()
    assert [h for h, row in enumerate(check.flags) if any("contradicted" in flag for flag in row)] == [4]


def test_several_harmonics_are_flagged_in_all_runs(loads):
    """A gyroscopic moment changed My of a check run by 4 %, and of a wind run by 26 % at 3/rev, without a flag."""
    flagged, found = flag_by_check_runs(_with_error(loads, "Fz", 0.05, slice(2, 5)))
    assert _flagged(flagged) == {("check", "Fz"), ("wind", "Fz")} and set(found[0].components) == {"Fz"}


def _with_mean(loads, share, flag=""):
    """The check run with a stated mean of Fz from which the reduced one departs by a share."""
    check = next(iter(loads.values()))
    m = check.components.index("Fz")
    applied, amplitude = check.check.applied.copy(), check.amplitude.copy()
    applied[0, m] = 2.0 * np.abs(applied[1:, m]).max()
    amplitude[0, m] = (1.0 + share) * applied[0, m]
    first = tuple(flag if i == m else word for i, word in enumerate(check.flags[0]))
    flags = (first, *check.flags[1:])
    return {
        **loads,
        check.run: replace(check, amplitude=amplitude, flags=flags, check=replace(check.check, applied=applied)),
    }


@pytest.mark.parametrize(
    ("share", "kinds"), [(0.005, set()), (0.08, {("check", "Fz")}), (-0.3, {("check", "Fz"), ("wind", "Fz")})]
)
def test_a_mean_that_differs_from_the_stated_one_is_flagged(loads, share, kinds):
    """A mean 8 % off its stated load had passed without a flag."""
    flagged, found = flag_by_check_runs(_with_mean(loads, share))
    assert _flagged(flagged) == kinds
    assert not any("contradicted" in flag for run in flagged.values() for row in run.flags[1:] for flag in row)
    assert [item.means for item in found] == ([{"Fz": pytest.approx(abs(share))}] if kinds else [])
    if kinds:
        assert f"stated ones of {found[0].run}, Fz by {100 * abs(share):.0f} %" in found[0].sentence


def test_a_record_without_a_zero_has_no_mean_to_compare(loads):
    assert _flagged(flag_by_check_runs(_with_mean(loads, 0.08, "no zero"))[0]) == set()


def test_an_error_within_sigma_contradicts_nothing(loads):
    wrong = next(iter(_with_error(loads, "Fz", 0.3, slice(1, None)).values()))
    wide = replace(wrong, sigma_cosine=wrong.sigma_cosine + 1e3)
    assert contradicted_components(wrong) and not contradicted_components(wide)


@pytest.mark.parametrize(
    ("harmonics", "factor", "words"), [(4, -1.0, "Fz -1"), (4, 1.1, ""), (2, -1.0, ""), (1, 0.1, "")]
)
def test_a_factor_between_loads_needs_several_harmonics(harmonics, factor, words):
    applied = np.zeros((harmonics + 1, 1), complex)
    applied[1:, 0] = np.random.default_rng(2).standard_normal((harmonics, 2)) @ [1.0, 1j]
    check = CheckErrors({"Fz": 0.1}, {}, {"Fz": 0.01}, {}, applied)
    said = scale_contradiction(check, factor * applied, ("Fz",))
    assert words in said and bool(said) == bool(words)


def test_a_load_that_was_not_applied_is_flagged_in_all_runs(loads):
    """Two channels exchanged on a rig without redundancy: 180 N of Fy for 70 N of Fx, and no flag but on Fx and Mz."""
    check = next(iter(loads.values()))
    name = next(iter(check.check.interaction))
    m = check.components.index(name)
    for share, is_found in ((0.1, False), (2.5, True)):
        amplitude = check.amplitude.copy()
        amplitude[1:, m] += 1e3 * share
        interaction = {**check.check.interaction, name: share}
        wrong = replace(check, amplitude=amplitude, check=replace(check.check, interaction=interaction))
        flagged, found = flag_by_check_runs({**loads, check.run: wrong})
        assert _flagged(flagged) == ({("check", name), ("wind", name)} if is_found else set())
        if is_found:
            assert f"{name} by 250 % of the largest applied force, where none was applied" in found[0].sentence
