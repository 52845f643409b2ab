"""Hub loads in time, by the command, on files of a simulated campaign: histories, gaps, calls that are refused."""

import json
from dataclasses import replace
from functools import cache

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.campaign.recording.run_file import write_run
from balance_cli.cli import balance
from balance_cli.io.artefacts import Provenance, load_artefact, save_artefact
from balance_cli.reduction import model_sources, paper_source
from balance_cli.reduction.choices import LOAD_MODELS
from balance_cli.reduction.result import HubLoads
from balance_cli.signals.rotor.azimuth import azimuth_from_pulses

FORMATS = {"balance-loads/1": HubLoads}
MADE = Provenance("a-test", {}, (), {}, "2026-01-02T03:04:05+00:00")
SHORT = 6.0
"""Length [s] of a record where the loads themselves are not checked."""


@pytest.fixture(scope="module")
def folder(campaign, calibration, identified, tmp_path_factory):
    """Calibration and model as artefacts, the rotor runs as files, one of them shortened."""
    folder = tmp_path_factory.mktemp("in-time")
    save_artefact(folder / "cal.h5", "balance-calibration/1", calibration, MADE)
    save_artefact(folder / "model.h5", "balance-model/1", identified, MADE)
    for run in campaign.runs_of_kind("check", "wind"):
        write_run(folder / f"{run.name}.h5", run)
    write_run(folder / "short.h5", changed(campaign.runs_of_kind("check")[0], "short", SHORT))
    return folder


def changed(run, name, length=None, change=None):
    """A run under another name, its first `length` seconds [s], its channels (n, c) in volts changed in place."""
    samples = run.samples if length is None else int(length * run.sample_rate)
    block = run.source.read(0, samples)
    channels = block.channels.copy()
    if change is not None:
        change(channels, np.arange(samples) / run.sample_rate)
    pulses = run.pulse_times[run.pulse_times < samples / run.sample_rate]
    return replace(run, name=name, samples=samples, source=MemorySource(channels, block.loads), pulse_times=pulses)


def reduced(folder, out, *words, run="short", status=0):
    """Run the command and return its result; the files are in `out`."""
    out.mkdir(exist_ok=True)
    call = ["reduce", "--calibration", folder / "cal.h5", "--model", folder / "model.h5", *words]
    call += [
        folder / f"{run}.h5" if isinstance(run, str) else run,
        "-o",
        out / "loads.h5",
        "--history",
        out / "histories",
        "--json",
        out / "loads.json",
    ]
    result = CliRunner().invoke(balance, [str(word) for word in call])
    assert result.exit_code == status, result.output + result.stderr
    return result


def summary(out, run="short"):
    return json.loads((out / "loads.json").read_text())["runs"][run]


def history(out, run="short"):
    with h5py.File(out / "histories" / f"{run}.h5") as file:
        found = {name: file[name][()] for name in ("time", "loads", "sigma")}
        if "harmonics" in file:
            found["harmonics"] = {name: item[()] for name, item in file["harmonics"].items()}
        return found


def error_of(campaign, run, found):
    """Return error less its mean, sigma and true loads of the inner half of a history (n, 6)."""
    truth = campaign.truths[run]
    n = len(found["time"])
    inner = slice(n // 4, 3 * n // 4)
    true = np.stack([np.interp(found["time"][inner], truth.time, column) for column in truth.loads.T], axis=1)
    error = found["loads"][inner] - true
    return (error - error.mean(axis=0)), found["sigma"][inner], true


# ---- loads and histories ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def smoothed(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("smoothed")
    return out, reduced(folder, out, "--method", "smoother", run="check-1")


def test_a_history_in_time_is_that_of_the_loads(campaign, smoothed):
    out, _ = smoothed
    found, run = history(out, "check-1"), campaign.runs_of_kind("check")[0]
    azimuth = azimuth_from_pulses(run.pulse_times)
    assert np.all(np.diff(found["time"]) > 0)
    assert found["time"][0] >= azimuth.first
    assert found["time"][-1] <= azimuth.last
    assert len(found["time"]) == pytest.approx((azimuth.last - azimuth.first) * run.sample_rate, abs=2)
    assert np.all(found["sigma"] > 0)
    error, sigma, true = error_of(campaign, "check-1", found)
    assert np.all(error.std(axis=0) < 3.0 * sigma.mean(axis=0))
    applied = np.any(true, axis=0)
    assert np.all(error.std(axis=0)[applied] < 0.05 * true.std(axis=0)[applied])


def test_amplitudes_of_a_history_are_those_of_the_table(smoothed):
    out, _ = smoothed
    harmonics = history(out, "check-1")["harmonics"]
    run = load_artefact(out / "loads.h5", FORMATS).content.runs["check-1"]
    r = len(harmonics["time"])
    assert harmonics["cosine"].shape == harmonics["sine"].shape == harmonics["sigma"].shape == (r, 9, 6)
    assert np.all(np.diff(harmonics["time"]) > 0)
    steady = (harmonics["time"] > run.interval[0]) & (harmonics["time"] < run.interval[1])
    steady[[0, -1]] = False
    mean = (harmonics["cosine"] - 1j * harmonics["sine"])[steady].mean(axis=0)
    np.testing.assert_array_less(np.abs(mean - run.amplitude)[1:], 3.0 * harmonics["sigma"][steady].mean(axis=0)[1:])
    np.testing.assert_allclose(mean[0].real, run.amplitude[0].real, atol=3.0 * run.sigma_cosine[0].max())


def test_means_of_revolutions_hold_nothing_of_the_harmonics(campaign, smoothed):
    """A revolution is not a whole number of samples; plain means would beat with the speed."""
    out, _ = smoothed
    found = history(out, "check-1")["harmonics"]
    largest = np.hypot(found["cosine"], found["sine"])[:, 1:].max()
    assert np.ptp(found["cosine"][1:-1, 0, 2]) < 0.05 * largest
    assert np.all(np.isnan(found["cosine"][[0, -1], 0]))


def test_text_and_summary_contain_the_innovation_tests(smoothed):
    out, result = smoothed
    assert "innovations: NIS" in result.output
    run_summary = summary(out, "check-1")
    assert json.loads((out / "loads.json").read_text())["method"] == "smoother"
    assert run_summary["load_model"] == run_summary["loads_as"] == "harmonics"
    assert run_summary["lag_s"] is None
    assert run_summary["nis"] == pytest.approx(1.0, abs=0.3)
    assert run_summary["nis_sigma"] < 0.05
    assert set(run_summary["channels"]) == set(run_summary["noise_v"])
    assert len(run_summary["noise_v"]) == 15
    assert run_summary["gap_notes"] == run_summary["bridged"] == []
    assert max(run_summary["load_error"].values()) < 0.02


def test_an_artefact_keeps_what_the_report_needs(smoothed):
    out, _ = smoothed
    loads = load_artefact(out / "loads.h5", FORMATS).content
    run = loads.runs["check-1"].in_time
    run_summary = summary(out, "check-1")
    assert loads.method == "smoother"
    assert (run.load_model, run.lag, run.gap_notes) == ("harmonics", None, ())
    assert run.innovations.nis == run_summary["nis"]
    assert run.innovations.channels == run_summary["channels"]
    assert run.noise == run_summary["noise_v"]
    found = history(out, "check-1")["harmonics"]
    np.testing.assert_array_equal(run.track.amplitude.real, found["cosine"])
    np.testing.assert_array_equal(run.track.time, found["time"])


@pytest.fixture(scope="module")
def each_model(folder, tmp_path_factory):
    """A function of method and load model: folder and result of their reduction, made once for all tests."""

    @cache
    def reduce(method, load_model):
        out = tmp_path_factory.mktemp(f"{method}-{load_model}")
        return out, reduced(folder, out, "--method", method, "--load-model", load_model)

    return reduce


@pytest.mark.parametrize("load_model", LOAD_MODELS)
@pytest.mark.parametrize("method", ["kalman", "smoother"])
def test_every_load_model(campaign, each_model, method, load_model):
    out, _ = each_model(method, load_model)
    found = history(out)
    assert np.all(np.isfinite(found["loads"])) and np.all(found["sigma"] > 0)
    assert ("harmonics" in found) == (load_model == "harmonics")
    error, sigma, _ = error_of(campaign, "check-1", found)
    assert np.all(np.sqrt(np.mean(error**2, axis=0)) < 4.0 * sigma.mean(axis=0))
    run_summary = summary(out)
    assert run_summary["load_model"] == load_model
    assert run_summary["lag_s"] == (0.05 if method == "kalman" else None)


def test_a_lag_makes_a_filter_surer(folder, tmp_path):
    words = ("--method", "kalman", "--load-model", "random")
    reduced(folder, tmp_path / "now", *words, "--lag", 0)
    reduced(folder, tmp_path / "late", *words, "--lag", 0.1)
    assert summary(tmp_path / "late")["lag_s"] == 0.1
    now, late = (np.median(history(tmp_path / name)["sigma"], axis=0) for name in ("now", "late"))
    assert np.all(late < now)


def test_the_default_given_explicitly_is_the_same_reduction(folder, each_model, tmp_path):
    explicit, _ = each_model("smoother", "harmonics")
    reduced(folder, tmp_path, "--method", "smoother")
    first, second = (load_artefact(out / "loads.h5", FORMATS) for out in (explicit, tmp_path))
    assert first.digest == second.digest


def test_the_former_name_of_the_load_model_is_the_same_reduction(folder, each_model, tmp_path):
    usual, result = each_model("smoother", "random")
    results = [result, reduced(folder, tmp_path, "--method", "smoother", "--loads-as", "random")]
    first, second = (load_artefact(out / "loads.h5", FORMATS) for out in (usual, tmp_path))
    assert first.digest == second.digest and first.provenance.options["loads-as"] == "random"
    assert [result.stderr.count("--loads-as is deprecated; use --load-model") for result in results] == [0, 1]


def test_fields_keep_their_names_in_files(smoothed):
    out, _ = smoothed
    with h5py.File(out / "loads.h5") as file:
        names = []
        file.visit(names.append)
    stored = {name.rpartition("/")[2] for name in names if name.endswith(("in_time/loads_as", "in_time/bridged"))}
    assert stored == {"loads_as", "bridged"}


# ---- gaps and channels lost for a while ------------------------------------------------------------------------------


def gap(start, stop):
    """All channels not a number from `start` to `stop` [s]."""

    def change(channels, time):
        channels[(time >= start) & (time < stop)] = np.nan

    return change


def test_a_short_gap_is_bridged_and_reported(campaign, folder, tmp_path):
    broken = changed(campaign.runs_of_kind("check")[0], "gap", change=gap(2.0, 2.2))
    write_run(tmp_path / "gap.h5", broken)
    reduced(folder, tmp_path / "out", "--method", "smoother", run=tmp_path / "gap.h5")
    run_summary, found = summary(tmp_path / "out", "gap"), history(tmp_path / "out", "gap")
    assert any(note.startswith("gap from 1.99") and note.endswith("bridged") for note in run_summary["notes"])
    assert run_summary["gap_notes"] and set(run_summary["gap_notes"]) <= set(run_summary["notes"])
    inside = (found["time"] > 2.05) & (found["time"] < 2.15)
    after = (found["time"] > 3.0) & (found["time"] < 4.0)
    assert inside.sum() > 50
    assert np.all(found["sigma"][inside].mean(axis=0) > found["sigma"][after].mean(axis=0))
    assert np.all(np.isfinite(found["loads"]))


def test_a_long_gap_is_refused_and_nothing_written(campaign, folder, tmp_path):
    write_run(tmp_path / "gap.h5", changed(campaign.runs_of_kind("check")[0], "gap", change=gap(2.0, 3.2)))
    result = reduced(folder, tmp_path / "out", "--method", "smoother", run=tmp_path / "gap.h5", status=2)
    assert "gap.h5" in result.stderr
    assert "at most 1 s" in result.stderr
    assert list((tmp_path / "out").iterdir()) == []


def test_with_skip_bad_a_run_that_is_refused_leaves_no_history(campaign, folder, tmp_path):
    write_run(tmp_path / "gap.h5", changed(campaign.runs_of_kind("check")[0], "gap", change=gap(2.0, 3.2)))
    words = ("--method", "smoother", "--load-model", "random", "--skip-bad", folder / "short.h5")
    reduced(folder, tmp_path / "out", *words, run=tmp_path / "gap.h5")
    assert [path.name for path in (tmp_path / "out" / "histories").iterdir()] == ["short.h5"]


def test_a_channel_at_its_range_for_a_while_is_bridged(campaign, calibration, identified, tmp_path):
    geometry = campaign.geometry
    channels = tuple(channel.model_copy(update={"range": 10.0}) for channel in geometry.channels)
    ranged = geometry.model_copy(update={"channels": channels})
    save_artefact(tmp_path / "cal.h5", "balance-calibration/1", replace(calibration, geometry=ranged), MADE)
    save_artefact(tmp_path / "model.h5", "balance-model/1", replace(identified, geometry=ranged), MADE)
    run = campaign.runs_of_kind("check")[0]
    column = run.channel_names.index("z1.piezo")

    def clip(channels, time):
        channels[(time > 3.0) & (time < 3.1), column] = 10.0

    write_run(tmp_path / "clipped.h5", changed(run, "clipped", SHORT, clip))
    reduced(tmp_path, tmp_path / "out", "--method", "smoother", "--load-model", "random", run="clipped")
    run_summary = summary(tmp_path / "out", "clipped")
    assert any("z1.piezo not used from" in note for note in run_summary["notes"])
    assert "z1.piezo" in run_summary["noise_v"]
    assert run_summary["channels_left_out"] == {}
    error, sigma, _ = error_of(campaign, "check-1", history(tmp_path / "out", "clipped"))
    assert np.all(np.sqrt(np.mean(error**2, axis=0)) < 4.0 * sigma.mean(axis=0))


# ---- refused calls ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--lag", 0.1), "--lag: a lag applies to a filter only"),
        (("--method", "smoother", "--lag", 0.1), "--lag: a lag applies to a filter only"),
        (("--method", "kalman", "--lag", -1), "--lag: lag must be finite and non-negative, not -1 s"),
        (("--method", "kalman", "--lag", "nan"), "--lag: lag must be finite and non-negative, not nan s"),
        (("--load-model", "harmonics"), "--load-model: a load model applies"),
        (("--method", "harmonic", "--load-model", "free"), "--load-model: a load model applies"),
        (("--method", "kalmann"), "'kalmann'"),
    ],
)
def test_options_that_do_not_go_together(folder, tmp_path, words, message):
    result = reduced(folder, tmp_path, *words, status=2)
    assert message in result.stderr
    assert result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("method", ["kalman", "smoother"])
def test_only_a_physical_model_has_a_state_space(campaign, folder, tmp_path, method):
    from balance_cli.signals.response.transfer import Transfer

    save_artefact(tmp_path / "tf.h5", "balance-transfer/1", Transfer(campaign.geometry, ()), MADE)
    for response in (("--static",), ("--transfer", tmp_path / "tf.h5")):
        words = ["reduce", "--calibration", folder / "cal.h5", *response, "--method", method, folder / "short.h5"]
        result = CliRunner().invoke(balance, [str(word) for word in [*words, "-o", tmp_path / "loads.csv"]])
        assert result.exit_code == 2
        assert "physical form" in result.stderr
        assert not (tmp_path / "loads.csv").exists()


def test_the_model_of_the_paper_is_refused(folder, identified, tmp_path, monkeypatch):
    """Its response is known at the harmonics only."""
    monkeypatch.setattr(model_sources, "model_source", lambda model: paper_source.PaperSource(model, None))
    monkeypatch.setattr(paper_source.PaperSource, "description", "paper form")
    result = reduced(folder, tmp_path, "--method", "smoother", status=2)
    assert "model.h5, --method smoother" in result.stderr
    assert "physical form" in result.stderr
    assert list(tmp_path.iterdir()) == []


# ---- the page --------------------------------------------------------------------------------------------------------


def test_the_page_shows_loads_in_time(smoothed, tmp_path):
    out, _ = smoothed
    words = ["report", out / "loads.h5", "-o", tmp_path / "r.html", "--json", tmp_path / "r.json"]
    result = CliRunner().invoke(balance, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    run_summary = json.loads((tmp_path / "r.json").read_text())
    assert run_summary["sections"]["in-time"] == "Loads in time"
    assert "in-time-1-check-1" in run_summary["figures"]
    page = (tmp_path / "r.html").read_text()
    assert "harmonics locked to the azimuth" in page
    assert "z4.piezo" in page


def test_loads_by_harmonics_have_no_such_section():
    from balance_cli.report.in_time import section
    from balance_cli.report.sources import Source, Sources
    from tests.support.report_content import loads

    source = Source("l.h5", None, loads())
    assert section(Sources(loads=(source,))) is None
