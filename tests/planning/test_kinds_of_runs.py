"""Runs that a plan chooses from beside flat sweeps: mean loads, hits beside the hub, static runs, shaped power."""

from pathlib import Path

import numpy as np
import pytest

from balance_cli.campaign.recording.point_loads import with_hub_loads
from balance_cli.campaign.recording.run_file import open_run, write_run
from balance_cli.estimation.deadline import Deadline
from balance_cli.estimation.likelihood import count_measured_values, data_chi2
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.planning.candidate_runs import candidate_runs
from balance_cli.planning.channel_noise import ChannelNoise, measured_noise
from balance_cli.planning.comparison import information_ratio
from balance_cli.planning.confusion import confused_pairs
from balance_cli.planning.design import Design
from balance_cli.planning.detectability import information_rows
from balance_cli.planning.extended_model import extended_model
from balance_cli.planning.hall import Hall, open_hall, record_settings
from balance_cli.planning.information import RunInformation, band_information, no_information, spectra_information
from balance_cli.planning.line_power import BandInformation, PowerProblem, optimal_powers, raise_weak_lines
from balance_cli.planning.rehearsal import lower_sample_rate, rehearse
from balance_cli.planning.run_words import condition_words, excitation_words, record_words
from balance_cli.simulation import NO_NOISE, SweepPlan, simulate_run, true_rig
from balance_cli.simulation.plans import ForcePoint
from balance_cli.simulation.signal_store import SignalStore
from tests.support.other_rigs import other_rig

HALL = {
    "format": "balance-hall/1",
    "exciters": {"Fx": {"rms": 30.0}, "Fz": {"rms": 60.0}},
    "period": 1.0,
    "periods": (4,),
    "levels": (1.0,),
}


def hall(**changes):
    return Hall(**{**HALL, **changes})


def candidates(letter="A", **changes):
    geometry = other_rig(letter)
    declared = hall(**changes)
    system = balance_model(geometry).system()
    return candidate_runs(geometry, declared, record_settings(geometry, declared), system)


@pytest.mark.parametrize(("letter", "periods"), [("A", (7, 15)), ("E", (20, 43))])
def test_records_of_quick_rigs_have_more_periods(letter, periods):
    settings = record_settings(other_rig(letter), open_hall())
    assert settings.periods == periods
    assert max(periods) * settings.period >= 10.0
    assert record_settings(other_rig(letter), hall()).periods == (4,)


def test_mean_loads_points_and_weights_are_candidates():
    points = {"corner": {"position": (0.2, 0.1, 0.0), "direction": (0.0, 0.0, -2.0)}}
    runs = candidates(
        trims=({}, {"Fz": 100.0}),
        hammer={"peak": 300.0, "points": points},
        minutes_per_point=0.5,
        static_loads={"Fx": 100.0, "Fz": 200.0},
    )
    words = [(excitation_words(run.plan), condition_words(run.plan), record_words(run.plan)) for run in runs]
    assert words[:2] == [("Fx", "at rest", "4 s"), ("Fz", "at rest", "4 s")]
    assert words[2][1] == "at rest, under Fz 100 N"
    assert ("hammer at corner", "at rest", "4 s") in words
    assert words[-2:] == [
        ("weights", "at rest, trim bare", "17 points"),
        ("weights", "at rest, trim Fz=100", "17 points"),
    ]
    assert len({run.setup for run in runs}) == len(runs) == 7
    assert runs[-1].minutes == pytest.approx(17 * 0.5 + 0.5)


def test_mean_loads_take_their_part_of_the_range():
    full = other_rig("A").cells[0].full_range
    free, loaded = (
        {
            run.plan.run.split("-")[0]: run.plan.level[0]
            for run in candidates(exciters={"Fz": {"peak": 1e9}}, trims=(trim,))
        }
        for trim in ({}, {"Fz": full})
    )
    assert loaded["Fz"] < free["Fz"]
    with pytest.raises(UserError, match="mean loads take more than 80 %"):
        candidates(trims=({"Fz": 20.0 * full},))


def test_force_beside_the_hub_is_recorded_and_read_back_as_hub_loads(tmp_path: Path):
    geometry = other_rig("A")
    point = ForcePoint(name="corner", position=(0.3, 0.1, -0.2), direction=(0.0, 0.0, -2.0))
    plan = SweepPlan(
        run="tap", excited=("Fz",), level=(10.0,), excitation="impact", contact=5e-3, period=1.0, periods=3, point=point
    )
    run = simulate_run(true_rig(geometry), plan, NO_NOISE)[0]
    loads = run.read().loads
    assert loads == pytest.approx(np.outer(loads[:, 2] / -1.0, point.wrench(geometry.hub)), abs=1e-6)
    assert np.sqrt(np.mean(loads[:, 2] ** 2)) == pytest.approx(10.0, rel=1e-3)
    write_run(tmp_path / "tap.h5", run)
    again = with_hub_loads(open_run(tmp_path / "tap.h5"), geometry)
    assert again.read().loads == pytest.approx(loads, rel=1e-6, abs=1e-6)
    assert len(measured_spectra([again], geometry).lines[0].components) == 3


def test_kept_signals_are_those_of_a_simulation_of_their_own():
    geometry = other_rig("A")
    store = SignalStore(true_rig(geometry), longest=4)
    plan = SweepPlan(run="Fx", excited=("Fx",), level=(30.0,), phases="low-crest", period=0.5, periods=4)
    short = plan.model_copy(update={"periods": 2, "level": (12.0,), "run": "other"})
    for each in (plan, short):
        kept, direct = (
            store.record(each, ChannelNoise(), 3),
            simulate_run(true_rig(geometry), each, ChannelNoise(), 3)[0],
        )
        # Rounding to the step of the converter may fall on either side.
        assert kept.read().channels == pytest.approx(direct.read().channels, abs=4e-4)
        assert kept.read().loads == pytest.approx(direct.read().loads, abs=1e-4)
        assert (kept.level, kept.period, kept.sample_rate) == (direct.level, direct.period, direct.sample_rate)
    assert len(store._kept) == 1


def test_rehearsal_at_a_lower_rate_has_the_lines_and_the_noise_density_of_the_record():
    geometry = other_rig("A")
    store, noise = SignalStore(true_rig(geometry)), ChannelNoise()
    plan = SweepPlan(
        run="Fx",
        excited=("Fx",),
        level=(30.0,),
        phases="low-crest",
        period=1.3,
        periods=6,
        band=(4.0, 150.0),
        sample_rate=2000.0,
    )
    fewer, _ = lower_sample_rate(plan, noise)
    assert fewer.sample_rate * plan.period == pytest.approx(976) and fewer.sample_rate < 0.4 * plan.sample_rate
    (low,) = rehearse(plan, store, noise, 3).lines
    (full,) = measured_spectra([store.record(plan, noise, 3)], geometry, means=True).lines
    assert low.frequency == pytest.approx(full.frequency)
    # The largest of 2292 differences of two values, each by four periods or more.
    sigma = (4.0 * noise.piezo**2 / (plan.sample_rate * 4.0 * plan.period)) ** 0.5
    assert np.abs(low.channels - full.channels).max() < 4.5 * sigma
    density = [measured_noise([lines], plan.sample_rate) for lines in (low, full)]
    ratio = [density[0][0][name] / density[1][0][name] for name in geometry.channel_names]
    # The median variance of the 190 lines of a channel scatters by a few percent.
    assert np.median(ratio) == pytest.approx(1.0, abs=0.03) and np.ptp(ratio) < 0.3
    assert density[0][1] == pytest.approx(density[1][1], rel=0.1)


def test_only_multisines_of_whole_periods_are_rehearsed_at_a_lower_rate():
    noise = ChannelNoise()
    plan = SweepPlan(run="Fx", excited=("Fx",), level=(30.0,), period=1.3, sample_rate=2000.0)
    for changes in ({"excitation": "random"}, {"period": 1.3002}, {"sample_rate": 740.0, "period": 2.0}):
        other = plan.model_copy(update=changes)
        assert lower_sample_rate(other, noise) == (other, noise)


def test_bands_add_up_to_the_run():
    geometry = other_rig("A")
    base = balance_model(geometry)
    model = extended_model(base.at(), ("channel-gain",))
    plan = SweepPlan(
        run="Fx", excited=("Fx",), level=(30.0,), phases="schroeder", period=1.0, periods=4, band=(4.0, 150.0)
    )
    spectra = measured_spectra([simulate_run(true_rig(geometry), plan)[0]], geometry)
    parts = band_information(spectra, model, np.array([4.0, 30.0, 70.0]))
    (whole,) = spectra_information(spectra, model)
    # The transient that a whole run eliminates takes a little of the information.
    ratio = np.diag(sum(parts)) / np.diag(whole.information)
    assert np.all(ratio > 1.0 - 1e-9) and np.median(ratio) < 1.2


def test_power_goes_where_it_tells_and_keeps_to_its_limit():
    geometry = other_rig("A")
    base = balance_model(geometry)
    model = extended_model(base.at(), ("channel-gain",))
    size = model.size
    tested = int(np.concatenate(model.indices.tested)[0])
    useful = np.zeros((size, size))
    useful[tested, tested] = 1e6
    parts = tuple(information_rows(matrix, model) for matrix in (useful, 0.0 * useful))
    share = np.array([0.25, 0.75])
    sweep = BandInformation("Fx", np.array([5.0, 50.0]), share, parts)
    power = optimal_powers(PowerProblem([sweep], no_information(model), model, None, "effects"))["Fx"]
    factors = np.array([value for _, value in power])
    # All that is not kept flat (a fifth) goes into the band that tells: 0.2 + 0.8 / 0.25.
    assert factors == pytest.approx([3.4, 0.2]) and factors @ share == pytest.approx(1.0)


def test_no_line_is_so_weak_that_its_spectrum_is_left_out():
    geometry = other_rig("A")
    power = raise_weak_lines(np.array([1.0, 1e-7]))
    plan = SweepPlan(
        run="Fz",
        excited=("Fz",),
        level=(60.0,),
        phases="low-crest",
        period=1.0,
        periods=3,
        band=(5.0, 100.0),
        power=tuple(zip((5.0, 60.0), map(float, power), strict=True)),
    )
    run, _ = simulate_run(true_rig(geometry), plan)
    (lines,) = measured_spectra([run], geometry).lines
    assert np.count_nonzero(lines.frequency > 0) == 96


def test_run_that_lowers_the_cosine_most_is_named():
    base = balance_model(other_rig("A"))
    model = extended_model(base.at(), ("channel-gain", "time-delay"))
    names = [item.effect.name for item in model.candidates]
    i, j = (int(model.indices.tested[names.index(name)][0]) for name in ("channel-gain", "time-delay"))

    def run(name, own, common):
        """A run that tells `own` of each of the two and `common` of both alike."""
        matrix = np.zeros((model.size, model.size))
        matrix[i, i] = matrix[j, j] = 1e12 * own
        matrix[i, j] = matrix[j, i] = 1e12 * common
        return RunInformation(name, matrix, 100.0)

    total, alike = run("made", 1.0, 0.999), run("alike", 1.0, 0.999)
    some, best = run("under weights", 1.0, 0.5), run("with the rotor turning", 1.0, -0.9)
    (pair,) = confused_pairs(total, model, [alike], [some, best])
    assert {pair.first.split("@")[0], pair.second.split("@")[0]} == {"channel-gain", "time-delay"}
    assert (pair.run, pair.further, pair.otherwise) == ("", "with the rotor turning", "")
    assert (pair.cosine, pair.cosine_with_further) == (pytest.approx(0.999), pytest.approx(0.0495, abs=1e-4))
    (pair,) = confused_pairs(total, model, [alike, some], [best])
    assert (pair.run, pair.further) == ("under weights", "") and pair.cosine_with_run == pytest.approx(0.7495, abs=1e-4)
    (pair,) = confused_pairs(total, model, [alike], [alike])
    reasons = {item.effect.separated_by for item in model.candidates}
    assert (pair.run, pair.further) == ("", "") and all(reason in pair.otherwise for reason in reasons)


def test_a_deadline_counts_the_seconds_of_computing_from_its_start():
    now = [10.0, 1.0]
    deadline = Deadline(5.0, (lambda: now[0], lambda: now[1]))
    now[0] = 100.0
    assert not deadline.is_over and not deadline.was_reached
    now[1] = 6.0
    assert deadline.is_over and deadline.was_reached
    assert not Deadline(None).is_over and Design((), 0.0).chosen == ()


def test_a_run_is_compared_by_the_parameters_of_which_it_tells_its_share():
    """A sweep of Mz shows by small asymmetries what others show well: that it shows it less is no fault of the run."""
    campaign, planned = np.array([1e6, 1e6, 50.0]), np.diag([2e4, 1.0, 50.0])
    assert information_ratio(np.diag([2e4, 1e-3, 50.0]), planned, campaign) == pytest.approx(1.0)
    assert information_ratio(np.diag([0.5e4, 1.0, 50.0]), planned, campaign) == pytest.approx(0.5)
    # A channel that was lost takes the whole information of its own parameters, which are not in the mean.
    assert information_ratio(np.diag([2e4, 1.0, 0.0]), planned, campaign) == pytest.approx(1.0)
    assert information_ratio(np.zeros((3, 3)), planned, campaign) == 0.0


def test_a_sweep_under_a_mean_load_fits_the_rig_with_its_mean():
    """The mean of the channels is by a load that is not excited, and no offset: chi2 per value was 3e5 with it."""
    geometry = other_rig("A")
    model = balance_model(geometry)
    sweep = SweepPlan(run="s", excited=("Fx",), level=(20.0,), period=1.0, periods=4, sample_rate=2000.0, band=(4, 180))
    for steady in ({"Fz": 400.0}, None):
        run, _ = simulate_run(true_rig(geometry), sweep.model_copy(update={"steady": steady}), seed=3)
        spectra = measured_spectra([run], geometry, means=True)
        batches = stack_runs(spectra.lines, (), geometry.channel_names)
        assert data_chi2(batches, model.system()) < 1.2 * count_measured_values(batches)
        covariance = np.diagonal(spectra.lines[0].covariance[-1]).real[: len(geometry.channels)]
        assert np.isinf(covariance).all() == (steady is not None)
