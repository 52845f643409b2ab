"""Records of programs that wait between readings: their samples are at the times that stand beside them."""

import numpy as np
import pytest

from balance_cli.campaign.recording.import_map import ImportMap
from balance_cli.campaign.recording.import_map_file import declared_runs
from balance_cli.importers import open_foreign
from balance_cli.importers.uneven_times import are_uneven
from balance_cli.io.errors import UserError
from balance_cli.steps.import_runs import import_run

COUNT, FREQUENCY = 500, 1.5


def logged(jitter, seed=4):
    """Times [s] of a loop that takes 40 ms, more or less by a share of it."""
    return 7.25 + np.cumsum(0.04 * (1.0 + jitter * np.random.default_rng(seed).uniform(-1, 1, COUNT)))


def write(path, times):
    rows = [f"{t:.9f},{np.sin(2 * np.pi * FREQUENCY * t):.9f},{k}" for k, t in enumerate(times)]
    path.write_text("\n".join(["t [s],F1 [V],count", *rows]) + "\n")
    return path


def imported(path, kind="zero", **keys):
    runs = [{"file": "*", "kind": kind, "run": "one"} | ({"trim": "a"} if kind == "static" else {})]
    mapping = {"format": "balance-import/1", "rig": "r", "runs": runs, "channels": {"F1": "z1"}, "time": "t"} | keys
    (declared,) = declared_runs(ImportMap.model_validate(mapping), [path], "map")
    result = import_run(declared, [open_foreign(path)])
    return result.run, np.concatenate([block.channels for block in result.run.blocks(100)])[:, 0], result.notes


@pytest.mark.parametrize("rate", [25.0, 12.5])
def test_samples_at_uneven_times_are_interpolated_to_the_stated_rate(tmp_path, rate):
    times = logged(0.3)
    run, values, notes = imported(write(tmp_path / "a.csv", times), resample=rate)
    assert run.sample_rate == rate and "samples at uneven times" in " ".join(notes)
    if rate == 25.0:  # the times of a lower rate begin behind its filter
        true = np.sin(2 * np.pi * FREQUENCY * (times[0] + np.arange(len(values)) / rate))
        assert np.abs(values - true).max() < 0.01
    assert np.std(values) == pytest.approx(np.sqrt(0.5), rel=0.03)


def test_without_a_rate_for_them_they_are_refused_with_the_key_that_helps(tmp_path):
    with pytest.raises(UserError, match="not even") as caught:
        imported(write(tmp_path / "a.csv", logged(0.3)))
    assert "`resample`" in str(caught.value.remedy)


def test_a_gap_is_refused_all_the_same(tmp_path):
    times = logged(0.3)
    times[250:] += 3.0
    with pytest.raises(UserError, match="not even") as caught:
        imported(write(tmp_path / "a.csv", times), resample=25.0)
    assert "Cut the record at the gap" in str(caught.value.remedy)


def test_even_times_and_load_points_are_left_as_they_are(tmp_path):
    run, values, notes = imported(write(tmp_path / "a.csv", 7.25 + np.arange(COUNT) / 25.0), resample=25.0)
    assert run.samples == COUNT and not notes
    _, values, notes = imported(write(tmp_path / "b.csv", logged(0.3)), "static", resample=25.0)
    assert np.abs(values - np.sin(2 * np.pi * FREQUENCY * logged(0.3))).max() < 1e-8 and not notes


def test_a_missing_sample_among_even_steps_is_no_jitter():
    steps = np.full(1000, 0.001)
    steps[400] = 0.002
    assert not are_uneven(steps) and are_uneven(np.diff(logged(0.1)))
