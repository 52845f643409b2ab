"""Batches: bad runs are skipped, workers may die, an interruption loses nothing, and the results stay the same."""

import json
import os
import shutil
import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.cli import balance, reduce_text
from balance_cli.cli.batch import journal as batch_journal
from balance_cli.cli.batch import reduction as batch_reduction
from balance_cli.cli.batch.executors import InlineExecutor, Workers, batch_workers
from balance_cli.cli.batch.journal import Journal, describe_kept_results, journal_path
from balance_cli.cli.batch.ordered import worker_pool
from balance_cli.cli.batch.reduction import BatchReduction
from balance_cli.cli.batch.work import RunResult
from balance_cli.io.errors import UserError
from studies.wind_runs import write_wind_runs

ROOT = Path(__file__).parents[2]
GEOMETRY = ROOT / "configs" / "rts-6.yaml"
COUNT = 9


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("batch")
    write_wind_runs(path, load_geometry(GEOMETRY), COUNT, duration=4.0)
    words = ["identify", "-g", str(GEOMETRY), *map(str, sorted((ROOT / "sample_data").glob("sweep-*-low.h5")))]
    done = CliRunner().invoke(balance, [*words, "--method", "computed", "-o", str(path / "model.h5")])
    assert done.exit_code == 0, done.stderr
    return path


def runs_of(folder):
    return sorted(folder.glob("wind-*.h5"))


def reduce(folder, output, *words, runs=None):
    paths = map(str, runs_of(folder) if runs is None else runs)
    words = ["reduce", "--model", str(folder / "model.h5"), *paths, "-o", str(output), *map(str, words)]
    return CliRunner().invoke(balance, words)


def digest(path):
    with h5py.File(path) as file:
        return file.attrs["digest"]


@pytest.fixture(scope="module")
def reference(folder):
    output = folder / "reference.h5"
    done = reduce(folder, output)
    assert done.exit_code == 0, done.stderr
    return digest(output)


# ---- bad runs --------------------------------------------------------------------------------------------------------


@pytest.fixture
def with_bad(folder, tmp_path):
    bad = tmp_path / "bad.h5"
    bad.write_bytes(runs_of(folder)[0].read_bytes()[:20_000])
    return [bad, *runs_of(folder)[:2]]


def test_a_bad_run_of_a_batch_is_listed_and_the_status_says_so(folder, with_bad, tmp_path):
    done = reduce(folder, tmp_path / "l.csv", "--json", tmp_path / "s.json", runs=with_bad)
    assert done.exit_code == 4
    assert "skipped:" in done.stderr and "bad.h5" in done.stderr
    summary = json.loads((tmp_path / "s.json").read_text())
    assert list(summary["skipped"]) == [str(with_bad[0])]
    assert list(summary["runs"]) == ["wind-00000", "wind-00001"]


def test_what_many_runs_have_is_one_line_and_each_of_them_in_the_json(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(reduce_text, "MOST_IN_FULL", COUNT - 1)
    for path in runs_of(folder):
        shutil.copy(path, tmp_path)
        with h5py.File(tmp_path / path.name, "r+") as file:
            file["channels"][:, 7] = 0.25
            file["channels"][100:103, 4] = np.nan
    done = reduce(folder, tmp_path / "l.h5", "--json", tmp_path / "s.json", runs=runs_of(tmp_path))
    assert done.exit_code == 0, done.stderr
    assert done.stderr.count("9 runs (wind-00000, wind-00001, wind-00002, ...)") == 3 == done.stderr.count("\n")
    assert len(done.stdout.splitlines()) < COUNT and done.stdout.count("channels are left out (x.piezo)") == 1
    summary = json.loads((tmp_path / "s.json").read_text())
    warnings = summary["warnings"]
    assert len(warnings) == 3 * COUNT and all(
        sum(f"wind-{i:05d}: " in text for text in warnings) == 2 for i in range(COUNT)
    )
    assert all(run["notes"] and run["channels_left_out"] for run in summary["runs"].values())


def test_each_run_has_the_harmonics_that_it_permits(folder, tmp_path):
    """A run that was skipped, and one whose band ends early, took harmonics from all others."""
    toothed, coarse = (
        shutil.copy(runs_of(folder)[i], tmp_path / f"{name}.h5") for i, name in ((1, "teeth"), (2, "low"))
    )
    with h5py.File(toothed, "r+") as file:
        pulses = file["rotor/pulse_times"][:]
        del file["rotor/pulse_times"]
        file["rotor/pulse_times"] = np.interp(np.arange(0, len(pulses) - 1, 0.25), np.arange(len(pulses)), pulses)
    with h5py.File(coarse, "r+") as file:
        step = int(file.attrs["sample_rate"] / (12.5 * file.attrs["rotor_speed"]))
        volts, attributes = file["channels"][::step], dict(file["channels"].attrs)
        del file["channels"]
        file.create_dataset("channels", data=volts).attrs.update(attributes)
        file.attrs["sample_rate"] /= step
    sound = runs_of(folder)[0]
    assert reduce(folder, tmp_path / "alone.csv", runs=[sound]).exit_code == 0
    done = reduce(folder, tmp_path / "all.csv", runs=[sound, toothed, coarse])
    assert done.exit_code == 4 and "skipped" in done.stderr
    (warning,) = [line for line in done.stderr.splitlines() if "in place of" in line]
    assert "wind-00002: 7 harmonics in place of 8" in warning
    rows = (tmp_path / "all.csv").read_text().splitlines()
    assert len(rows) == 1 + 6 * (9 + 8)
    assert (tmp_path / "alone.csv").read_text().splitlines()[1:] == [row for row in rows if "wind-00000" in row]
    shards = [tmp_path / f"{i}.h5" for i in (1, 2)]
    for i, shard in enumerate(shards, 1):
        assert reduce(folder, shard, "--shard", f"{i}/2", runs=[sound, coarse]).exit_code == 0
    words = ["merge", *map(str, shards), "-o", str(tmp_path / "merged.h5")]
    assert CliRunner().invoke(balance, words).exit_code == 0


def test_whoever_expects_bad_runs_gets_status_zero(folder, with_bad, tmp_path):
    assert reduce(folder, tmp_path / "l.csv", "--skip-bad", runs=with_bad).exit_code == 0


@pytest.mark.parametrize("words", [("--strict",), ("--strict", "--jobs", "2")])
def test_strict_ends_at_the_first_bad_run(folder, with_bad, tmp_path, words):
    done = reduce(folder, tmp_path / "l.csv", *words, runs=with_bad)
    assert done.exit_code == 2
    assert "bad.h5" in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.h5"]


def test_a_single_bad_run_is_an_error(folder, with_bad, tmp_path):
    assert reduce(folder, tmp_path / "l.csv", runs=with_bad[:1]).exit_code == 2


def test_a_batch_of_bad_runs_only_is_an_error(folder, with_bad, tmp_path):
    (tmp_path / "other.h5").write_text("nothing")
    done = reduce(folder, tmp_path / "l.csv", runs=[with_bad[0], tmp_path / "other.h5"])
    assert done.exit_code == 2 and "all runs were skipped" in done.stderr


@pytest.mark.parametrize(
    ("words", "place"),
    [
        (("--strict", "--skip-bad"), "--strict"),
        (("--shard", "3/2"), "--shard"),
        (("--shard", "one"), "--shard"),
        (("--shard", "30/30"), "--shard"),
        (("--executor", "localhost:8786"), "--executor"),
        (("--executor", "dask://h:1", "--jobs", "2"), "--executor"),
    ],
)
def test_options_that_cannot_be_are_refused(folder, tmp_path, words, place):
    done = reduce(folder, tmp_path / "l.csv", *words)
    assert done.exit_code == 2 and place in done.stderr and not list(tmp_path.iterdir())


# ---- the same results ------------------------------------------------------------------------------------------------


def test_loads_are_the_same_from_processes_in_any_order(folder, reference, tmp_path):
    done = reduce(folder, tmp_path / "l.h5", "--jobs", 2, runs=runs_of(folder)[::-1])
    assert done.exit_code == 0, done.stderr
    assert digest(tmp_path / "l.h5") == reference


def test_merged_shards_are_the_loads_of_one_call(folder, reference, tmp_path):
    for index in (1, 2, 3):
        assert reduce(folder, tmp_path / f"{index}.h5", "--shard", f"{index}/3").exit_code == 0
    words = ["merge", *(str(tmp_path / f"{index}.h5") for index in (3, 1, 2)), "-o", str(tmp_path / "l.h5")]
    assert CliRunner().invoke(balance, words).exit_code == 0
    assert digest(tmp_path / "l.h5") == reference


def test_shards_share_the_survey_of_all_headers(folder, reference, tmp_path, monkeypatch):
    """The second shard reads headers of runs that have changed only; a run of another name shows."""
    surveyed = []
    survey_run = batch_reduction.work.survey_run
    monkeypatch.setattr(
        batch_reduction.work, "survey_run", lambda item: surveyed.append(item.path.name) or survey_run(item)
    )
    runs = [tmp_path / path.name for path in runs_of(folder)]
    for path, run in zip(runs_of(folder), runs, strict=True):
        run.write_bytes(path.read_bytes())
    options = ("--survey", tmp_path / "runs.json", "--shard")
    assert reduce(folder, tmp_path / "1.h5", *options, "1/2", runs=runs).exit_code == 0
    assert len(surveyed) == COUNT
    os.utime(runs[3])
    assert reduce(folder, tmp_path / "2.h5", *options, "2/2", runs=runs).exit_code == 0
    assert surveyed[COUNT:] == [runs[3].name]
    merged = tmp_path / "merged.h5"
    words = ["merge", str(tmp_path / "1.h5"), str(tmp_path / "2.h5"), "-o", str(merged)]
    assert CliRunner().invoke(balance, words).exit_code == 0
    assert digest(merged) == reference


@pytest.mark.parametrize("text", ["name,value", "[1, 2]", '{"format": "balance-survey/1", "checksum": "", "runs": {}}'])
def test_a_file_that_is_no_survey_is_not_overwritten(folder, tmp_path, text):
    (tmp_path / "notes.txt").write_text(text)
    done = reduce(folder, tmp_path / "l.csv", "--survey", tmp_path / "notes.txt", runs=runs_of(folder)[:1])
    assert done.exit_code == 2 and "notes.txt" in done.stderr and "--survey" in done.stderr
    assert (tmp_path / "notes.txt").read_text() == text


def test_shards_of_two_reductions_are_not_merged(folder, tmp_path):
    assert reduce(folder, tmp_path / "1.h5", "--shard", "1/9").exit_code == 0
    assert reduce(folder, tmp_path / "2.h5", "--shard", "2/9", "--harmonics", "4").exit_code == 0
    files = [str(tmp_path / "1.h5"), str(tmp_path / "2.h5")]
    done = CliRunner().invoke(balance, ["merge", *files, "-o", str(tmp_path / "l.h5")])
    assert done.exit_code == 2 and "an option of the reduction" in done.stderr and "2.h5" in done.stderr
    done = CliRunner().invoke(balance, ["merge", files[0], "-o", str(tmp_path / "part.h5")])
    assert done.exit_code == 0
    assert "missing: shard 2/9, 3/9, 4/9, 5/9, 6/9, 3 more" in done.stderr
    done = CliRunner().invoke(balance, ["merge", files[0], files[0], "-o", str(tmp_path / "l.h5")])
    assert done.exit_code == 2 and "wind-00000" in done.stderr


# ---- interruptions ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("histories", [False, True])
def test_an_interrupted_batch_goes_on_where_it_stopped(folder, reference, tmp_path, monkeypatch, histories):
    output, done_before, work = tmp_path / "l.h5", [], batch_reduction.work.reduce_file
    words = ("--history", tmp_path / "histories") if histories else ()

    def interrupt_at_the_sixth(item):
        if len(done_before) == 5:
            raise KeyboardInterrupt  # as a power cut: the journal is left as it is
        done_before.append(item.path)
        return work(item)

    monkeypatch.setattr(batch_reduction.work, "reduce_file", interrupt_at_the_sixth)
    monkeypatch.setattr(Journal, "close", lambda journal, remove=True: journal._file.close())
    assert reduce(folder, output, *words).exit_code != 0
    assert "5 reduced runs are kept in " in describe_kept_results()
    monkeypatch.undo()
    kept = journal_path(output)
    kept.write_bytes(kept.read_bytes()[:-40])  # the last line was not written whole
    again = []
    monkeypatch.setattr(batch_reduction.work, "reduce_file", lambda item: (again.append(item.path), work(item))[1])
    done = reduce(folder, output, *words)
    assert done.exit_code == 0 and "4 of 9 runs" in done.stdout
    assert again == runs_of(folder)[4:]
    assert digest(output) == reference
    assert sorted(path.name for path in tmp_path.iterdir()) == (["histories"] if histories else []) + ["l.h5"]
    if histories:
        assert [path.name for path in sorted((tmp_path / "histories").iterdir())] == [p.name for p in runs_of(folder)]


def test_a_history_that_is_gone_is_made_again(folder, tmp_path, monkeypatch):
    words, work = ("--history", tmp_path / "histories"), batch_reduction.work.reduce_file
    monkeypatch.setattr(BatchReduction, "_stage_histories", lambda batch, reduction: 1 / 0)
    monkeypatch.setattr(Journal, "close", lambda journal, remove=True: journal._file.close())
    assert reduce(folder, tmp_path / "l.h5", *words).exit_code == 1
    monkeypatch.undo()
    (tmp_path / ".l.h5.histories" / "wind-00003.h5").unlink()
    again = []
    monkeypatch.setattr(batch_reduction.work, "reduce_file", lambda item: (again.append(item.path.name), work(item))[1])
    assert reduce(folder, tmp_path / "l.h5", *words).exit_code == 0
    assert again == ["wind-00003.h5"] and len(list((tmp_path / "histories").iterdir())) == COUNT


def test_a_journal_of_another_call_is_not_used(tmp_path):
    result = RunResult("a", "wind", "d", {"x": {"samples": 1}}, "text", None, None, (1.0, float("nan")))
    file = tmp_path / "run.h5"
    file.write_text("samples")
    journal = Journal(tmp_path / "j", "key", RunResult)
    journal.add(file, result)
    journal.close(remove=False)
    same = Journal(tmp_path / "j", "key", RunResult)
    restored = same.find(file)
    assert restored is not None and restored.gaps == result.gaps and np.isnan(restored.level[1])
    os.utime(file, ns=(1, 1))
    assert same.find(file) is None  # the file has changed
    same.close(remove=False)
    other = Journal(tmp_path / "j", "other key", RunResult)
    assert len(other) == 0
    other.close()
    assert not (tmp_path / "j").exists()


def test_a_journal_that_the_call_before_has_just_removed_is_not_used(tmp_path, monkeypatch):
    def remove_and_lock(file):
        (tmp_path / "j").unlink()  # as the other call does, between opening and lock
        return True

    with monkeypatch.context() as patch:
        patch.setattr(batch_journal, "_lock", remove_and_lock)
        late = Journal(tmp_path / "j", "key", RunResult)
    third = Journal(tmp_path / "j", "key", RunResult)
    assert (late.is_mine, third.is_mine) == (False, True)
    history = third.history("run")
    history.touch()
    late.close()
    assert history.exists() and (tmp_path / "j").exists()
    third.close()
    assert list(tmp_path.iterdir()) == []


# ---- workers ---------------------------------------------------------------------------------------------------------


def _double(number):
    return 2 * number


def _kill_worker_once(marker):
    """Kill this process where the marker is there; without it return."""
    if marker.exists():
        if marker.suffix == ".once":
            marker.unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    return marker.name


def test_results_have_the_order_of_the_items_and_few_are_in_work():
    begun = []

    def items():
        for number in range(50):
            begun.append(number)
            yield number

    with ThreadPoolExecutor(4) as threads, worker_pool(Workers(lambda: threads, 8)) as pool:
        for number, result in pool.results(_double, items()):
            assert result == 2 * number
            assert len(begun) <= number + 9
    assert len(begun) == 50


@pytest.mark.parametrize("names", [("a", "b.once", "c", "d.always", "e"), ("d.always", "a", "b.once", "c", "e")])
def test_a_killed_worker_costs_nothing_and_one_that_dies_again_is_named(tmp_path, names):
    for name in ("b.once", "d.always"):
        (tmp_path / name).touch()
    with worker_pool(batch_workers(2, None)) as pool:
        results = dict(pool.results(_kill_worker_once, [tmp_path / name for name in names]))
    outcome = {path.name: result for path, result in results.items()}
    assert [outcome[name] for name in ("a", "b.once", "c", "e")] == ["a", "b.once", "c", "e"]
    assert isinstance(outcome["d.always"], UserError) and "d.always" in str(outcome["d.always"])


def test_errors_come_with_their_item():
    def refuse(number):
        raise UserError(f"number {number}")

    with worker_pool(Workers(InlineExecutor, 1)) as pool:
        assert [str(error) for _, error in pool.results(refuse, [1, 2])] == ["number 1", "number 2"]


# ---- runs on object stores -------------------------------------------------------------------------------------------


@pytest.fixture
def store(folder):
    system = pytest.importorskip("fsspec").filesystem("memory")
    for path in runs_of(folder):
        system.pipe(f"/batch/{path.name}", path.read_bytes())
    yield system
    system.rm("/batch", recursive=True)


def test_runs_of_a_store_give_the_same_result_as_files(folder, reference, store, tmp_path):
    urls = [f"memory://batch/{path.name}" for path in runs_of(folder)]
    done = reduce(folder, tmp_path / "l.h5", runs=urls)
    assert done.exit_code == 0, done.stderr
    assert digest(tmp_path / "l.h5") == reference


def test_bad_runs_of_a_store_are_named_by_their_url(folder, store, tmp_path):
    store.pipe("/batch/bad.h5", runs_of(folder)[0].read_bytes()[:20_000])
    names = [runs_of(folder)[1].name, "bad.h5", "absent.h5"]
    urls = [*(f"memory://batch/{name}" for name in names), "nowhere://batch/a.h5"]
    done = reduce(folder, tmp_path / "l.csv", "--json", tmp_path / "s.json", runs=urls)
    assert done.exit_code == 4, done.stderr
    skipped = " ".join(json.loads((tmp_path / "s.json").read_text())["skipped"].values())
    assert "memory://batch/bad.h5: cannot be read, it is truncated" in skipped
    assert "memory://batch/absent.h5: there is no such file" in skipped
    assert "nowhere://batch/a.h5: cannot be read from the store" in skipped
    assert "/tmp" not in skipped


def test_a_journal_notices_that_a_file_of_a_store_has_changed(folder, store):
    path = Path(f"memory://batch/{runs_of(folder)[0].name}")
    before = batch_journal.file_stamp(path)
    assert batch_journal.file_stamp(path) == before != "absent"
    store.pipe(f"/batch/{path.name}", b"something else")
    assert batch_journal.file_stamp(path) not in (before, "absent")
