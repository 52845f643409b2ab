"""Hammer records: recognized where they are declared as something else, taps and bounces counted, responses right."""

import json
from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
from click.testing import CliRunner

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.recording.run_file import write_run
from balance_cli.cli import balance
from balance_cli.io.errors import UserError
from balance_cli.signals.impact import (
    find_hits,
    hammer_record,
    has_short_hits,
    is_mostly_hits,
    use_hammer_record,
    window_forces,
)
from balance_cli.signals.local.response import local_response

RATE, FINE, SAMPLES = 1000.0, 16, 20000
MODES = ((40.0, 0.01, 5e3), (95.0, 0.008, 2e4))
RNG = np.random.default_rng(7)
GEOMETRY = """format: balance-geometry/1
name: rig
rig: rig
hub: [0.0, 0.0, 0.0]
bodies: [{name: mass, mass: 1.0, position: [0.0, 0.0, 0.0], inertia: {xx: 1.0, yy: 1.0, zz: 1.0}}]
cells: [{name: z, position: [0.0, 0.0, 0.0], axis: [0.0, 0.0, 1.0], stiffness: 6.3e4, full_range: 500.0}]
channels: [{name: c, cell: z, sensitivity: 0.08}]
freedom: [z]
damping_ratio: 0.01
"""


def taps(times, width=0.004):
    """Half sines of a hammer at these times [s], sampled at RATE * FINE."""
    time = np.arange(SAMPLES * FINE) / (RATE * FINE)
    force = np.zeros(len(time))
    for k, start in enumerate(times):
        inside = (time >= start) & (time < start + width)
        force[inside] += (100.0 + 7.0 * k) * np.sin(np.pi * (time[inside] - start) / width)
    return force


def hammer_run(times, noise=0.02):
    """A two-mode system tapped at these times; load and channel behind one anti-alias filter."""
    force, response = taps(times), 0.0
    for frequency, damping, gain in MODES:
        omega = 2 * np.pi * frequency
        system = ([gain], [1.0, 2 * damping * omega, omega**2])
        numerator, denominator, _ = scipy.signal.cont2discrete(system, 1 / (RATE * FINE), method="foh")
        response = response + scipy.signal.lfilter(numerator.ravel(), denominator, force)
    sections = scipy.signal.butter(8, 350.0, fs=RATE * FINE, output="sos")
    sampled = [scipy.signal.sosfilt(sections, signal)[::FINE] for signal in (force, response)]
    loads = np.zeros((SAMPLES, 6))
    loads[:, 2] = sampled[0] + noise * RNG.standard_normal(SAMPLES)
    channel = sampled[1] + 0.01 * noise * RNG.standard_normal(SAMPLES)
    source = MemorySource(channel[:, None], loads)
    return Run(
        *("hammer", "rig", "sweep", ("c",), SAMPLES, source, True, RATE),
        excited=("Fz",),
        excitation="impact",
        level=(5.0,),
    )


def exact(frequency):
    s = 2j * np.pi * frequency
    return sum(g / (s**2 + 2 * z * 2 * np.pi * f * s + (2 * np.pi * f) ** 2) for f, z, g in MODES)


def test_response_of_a_hammer_record():
    found = local_response(hammer_run([1.3, 5.1, 9.4, 14.2]), ("c",), "lrm")
    error = np.abs(found.response[:, 0, 0] - exact(found.frequency))
    sigma = np.sqrt(np.abs(found.channel_covariance[:, 0, 0] * found.load_covariance[:, 0, 0]))
    assert 0.8 < np.sqrt(np.median((error / sigma) ** 2) / np.log(2)) < 1.25  # |z|^2 of complex noise is exponential
    inner = found.frequency < 200.0
    assert np.median(error[inner] / np.abs(exact(found.frequency[inner]))) < 0.01
    assert found.frequency[-1] < 380.0  # the spectrum of a half sine of 4 ms has its first zero at 375 Hz


def test_a_hammer_declared_as_random_is_refused():
    run = replace(hammer_run([1.3, 5.1, 9.4]), excitation="random")
    with pytest.raises(UserError, match="zero but for short hits") as caught:
        local_response(run, ("c",), "lrm")
    assert "impact" in caught.value.remedy


@pytest.mark.parametrize(
    "load",
    [
        RNG.standard_normal(5000),
        np.sin(np.arange(5000) ** 2 / 2e4),
        np.where(np.arange(5000) % 1000 < 500, RNG.standard_normal(5000), 0.0),
        np.zeros(5000),
        np.random.default_rng(3).standard_normal(20000) + 50.0 * (np.arange(20000) == 7000),  # one wrong sample
    ],
)
def test_other_loads_are_no_hits(load):
    assert not has_short_hits(load) and not is_mostly_hits(load)


def test_hits_of_a_cell_that_drifts_are_hits():
    """As in the public record of a beam: 43 % of the power of the force below 2 Hz, after one tap."""
    force = taps([1.0, 4.0])[::FINE]
    drift = np.sin(0.3 * np.arange(SAMPLES) / RATE)
    load = force + drift * np.sqrt(0.7 * np.sum(force**2) / np.sum(drift**2))
    assert not has_short_hits(load) and is_mostly_hits(load)


def test_taps_and_bounces_are_counted():
    force = taps([1.0, 4.0, 4.05, 9.0])[::FINE] + 0.1 * RNG.standard_normal(SAMPLES)
    hits = find_hits(force, RATE)
    assert np.allclose(hits.times, [1.002, 4.002, 4.052, 9.002], atol=0.002)
    assert hits.is_double.tolist() == [False, False, True, False]
    assert hits.note.startswith("3 taps") and "bounced once (first at 4.05" in hits.note and has_short_hits(force)


@pytest.mark.parametrize("order", [6, 8, 10, 401])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_ringing_of_an_anti_alias_filter_is_no_rebound(order, sign):
    """Taps of 1 ms behind Butterworth filters of 350 Hz, and one of linear phase that rings before the hit, too."""
    nyquist = RATE * FINE
    b, a = (scipy.signal.firwin(order, 350.0, fs=nyquist), [1.0]) if order > 100 else ([1.0], [1.0])
    sections = scipy.signal.butter(min(order, 10), 350.0, fs=nyquist, output="sos")
    for times, doubles in (([1.3, 5.1, 9.4, 14.2], []), ([1.3, 5.1, 5.16, 9.4], [2])):
        force = sign * taps(times, width=0.001)
        filtered = scipy.signal.lfilter(b, a, force) if order > 100 else scipy.signal.sosfilt(sections, force)
        hits = find_hits(filtered[::FINE], RATE)
        assert np.allclose(hits.times, times, atol=0.02)
        assert np.flatnonzero(hits.is_double).tolist() == doubles


def test_a_tap_that_bounced_is_dropped_and_the_rest_is_right():
    run = hammer_run([1.3, 5.1, 5.16, 9.4, 14.2])
    record = hammer_record(run)
    assert record.summary["bounced"] == [2] and record.summary["dropped"] == [1, 2]
    assert np.allclose(record.taps, [1.3, 5.1, 9.4, 14.2], atol=0.01)
    assert "tap 2 (at 5.1" in record.note and "with 2" in record.note
    part = use_hammer_record(run)
    assert part.samples == SAMPLES - record.start and abs(record.start / RATE - 9.4) < 0.03
    found = local_response(part, ("c",), "lrm")
    error = np.abs(found.response[:, 0, 0] - exact(found.frequency))
    inner = found.frequency < 200.0
    assert np.median(error[inner] / np.abs(exact(found.frequency[inner]))) < 0.01


def test_a_record_of_bounces_alone_is_refused():
    with pytest.raises(UserError, match="every tap of the hammer bounced"):
        hammer_record(hammer_run([1.3, 1.36, 9.4, 9.47]))


def test_the_force_window_keeps_hits_and_takes_noise_out_between_them():
    clean = taps([1.0, 4.0, 9.0])[::FINE]
    force = clean + 3.0 + 0.5 * RNG.standard_normal(SAMPLES)
    windowed = window_forces(force[:, None])
    assert 0.45 < windowed.noise[0] < 0.55 and windowed.samples < 0.01 * SAMPLES
    assert np.abs(windowed.loads[:, 0] - clean).max() < 2.5
    assert np.sum((windowed.loads[:, 0] - clean) ** 2) < 0.02 * np.sum((force - 3.0 - clean) ** 2)
    noise = RNG.standard_normal((SAMPLES, 1))
    assert window_forces(noise).loads is noise


def test_a_command_names_the_taps_of_a_record(tmp_path):
    """The second of three bounces: the first alone, or the third, is used."""
    run = hammer_run([1.3, 5.1, 5.15, 9.4])
    write_run(tmp_path / "hammer.h5", run, run.blocks(SAMPLES))
    (tmp_path / "rig.yaml").write_text(GEOMETRY, encoding="utf-8")
    words = ["sweep-tf", "-g", tmp_path / "rig.yaml", tmp_path / "hammer.h5", "--json", tmp_path / "summary.json"]
    words += ["--to", 30, "-o", tmp_path / "tf.h5"]
    result = CliRunner().invoke(balance, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    record = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))["hammer"]["hammer"]
    np.testing.assert_allclose(record["taps"], [1.3, 5.1, 9.4], atol=0.01)
    assert record["bounced"] == [2] and len(record["dropped"]) == 2 and 2 in record["dropped"]
    assert "tap 2 (at 5.1" in result.output
