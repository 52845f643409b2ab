"""Effects in channels and exciters: what each does to spectra and readings, by its own formula."""

import numpy as np
import pytest

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.io.errors import UserError
from balance_cli.simulation import (
    NO_NOISE,
    Noise,
    RotorPlan,
    StaticPlan,
    SweepPlan,
    ZeroPlan,
    simulate_run,
    true_rig,
)
from balance_cli.simulation.excitation import multisine, multisine_lines
from balance_cli.simulation.extensions.library import extension
from balance_cli.simulation.rig import apply_effects
from tests.support.simulation_rig import GEOMETRY

SWEEP = SweepPlan(run="s", excited=("Fy",), level=(30.0,), period=1.0, periods=6)
STATIC = StaticPlan(run="t", largest={"Fx": 800.0, "Fz": 3500.0}, steps=2)
FREQUENCY = np.arange(2, 151)


def spectra(*extensions, plan=SWEEP):
    """Amplitudes of channels and loads (149, .) in the last second."""
    block = simulate_run(true_rig(GEOMETRY).with_extensions(*extensions), plan, NO_NOISE)[0].read()
    return (np.fft.rfft(part[-800:], axis=0)[FREQUENCY] / 400 for part in (block.channels, block.loads))


S = 2j * np.pi * FREQUENCY
PLAIN = list(spectra())


@pytest.mark.parametrize(
    ("name", "parameters", "factor"),
    [
        ("time-delay", {"delay": 0.0013}, np.exp(-0.0013 * S)),
        ("time-delay", {"delay": -0.00071}, np.exp(0.00071 * S)),
        ("low-pass", {"cutoff": 120.0}, 1 / (1 + S / (2 * np.pi * 120))),
        ("high-pass", {"cutoff": 3.0}, S / (S + 2 * np.pi * 3)),
        ("channel-gain", {"gain": 0.97}, np.full(149, 0.97)),
    ],
)
def test_linear_channel_effects(name, parameters, factor):
    channels, loads = spectra(extension(name, ("z1.strain",), **parameters))
    np.testing.assert_allclose(channels[:, 1], factor * PLAIN[0][:, 1], rtol=2e-5)
    np.testing.assert_array_equal(channels[:, [0, 2, 3]], PLAIN[0][:, [0, 2, 3]])
    np.testing.assert_array_equal(loads, PLAIN[1])


def test_crosstalk_mixes_volts():
    channels, _ = spectra(extension("crosstalk", ("torque", "x.strain"), fraction=0.1))
    np.testing.assert_allclose(channels[:, 0], 0.1 * PLAIN[0][:, 3], rtol=1e-9)
    with pytest.raises(UserError, match="two different places"):
        spectra(extension("crosstalk", ("torque",), fraction=0.1))


def test_misaligned_exciter_acts_but_is_not_measured():
    channels, loads = spectra(extension("exciter-misalignment", ("Fy", "Mx"), fraction=0.05))
    moment, _ = spectra(plan=SWEEP.model_copy(update={"excited": ("Mx",)}))
    np.testing.assert_array_equal(loads, PLAIN[1])
    np.testing.assert_allclose(channels[:, 1], PLAIN[0][:, 1] + 0.05 * moment[:, 1], rtol=1e-6)
    rig = true_rig(GEOMETRY).with_extensions(extension("exciter-misalignment", ("Fz", "Fx"), fraction=0.02))
    wind = RotorPlan(run="w", kind="wind", rotor_speed=17.0, duration=1.0, harmonics={"Fz": (10.0,)})
    assert np.all(simulate_run(rig, wind)[1].loads[:, 0] == 0)
    assert np.all(simulate_run(rig, STATIC, NO_NOISE)[1].loads[9:, 0] == 0)
    rig = true_rig(GEOMETRY).with_extensions(extension("weight-misalignment", ("Fz", "Fx"), fraction=0.02))
    at_rest = simulate_run(rig, STATIC, NO_NOISE)
    np.testing.assert_allclose(at_rest[1].loads[9:, 0], 0.02 * at_rest[1].loads[9:, 2])
    assert np.all(at_rest[0].read().loads[9:, 0] == 0)


def test_offsets_shift_what_is_read():
    rig = apply_effects(
        true_rig(GEOMETRY),
        [
            DeclaredEffect(name="channel-offset", where=("x.strain",), parameters={"offset": 0.01}),
            DeclaredEffect(name="load-offset", where=("Fx",), parameters={"offset": 2.0}),
        ],
    )
    run, truth = simulate_run(rig, STATIC, NO_NOISE)
    plain = simulate_run(true_rig(GEOMETRY), STATIC, NO_NOISE)[0].read()
    np.testing.assert_allclose(run.read().channels - plain.channels, [[0, 0, 0.01]] * 17, atol=1e-12)
    np.testing.assert_allclose(run.read().loads[:, 0] - truth.loads[:, 0], np.where(truth.loads[:, 0] != 0, 2.0, 0.0))
    quiet = simulate_run(rig, ZeroPlan(run="z", duration=1.0), NO_NOISE)[0]
    np.testing.assert_allclose(quiet.read().channels, [[0, 0, 0, 0.01]] * 800, atol=1e-12)
    assert not quiet.has_loads


def test_pickup_has_its_frequency_and_amplitude():
    rig = true_rig(GEOMETRY).with_extensions(extension("mains-pickup", ("torque",), amplitude=0.02, frequency=50.0))
    volts = simulate_run(rig, ZeroPlan(run="z", duration=2.0), NO_NOISE)[0].read().channels
    spectrum = np.abs(np.fft.rfft(volts[800:], axis=0)) / 400
    assert spectrum[50, 0] == pytest.approx(0.02, rel=1e-4)
    assert np.max(np.delete(spectrum[:, 0], 50)) < 1e-5
    assert np.all(volts[:, 1:] == 0)


def test_readings_at_rest_know_no_dynamics():
    effects = [
        extension("time-delay", ("x.strain",), delay=0.01),
        extension("low-pass", ("x.strain",), cutoff=1.0),
        extension("mains-pickup", ("x.strain",), amplitude=1.0),
        extension("high-pass", ("z1.strain",), cutoff=1.0),
    ]
    volts = simulate_run(true_rig(GEOMETRY).with_extensions(*effects), STATIC, NO_NOISE)[0].read().channels
    plain = simulate_run(true_rig(GEOMETRY), STATIC, NO_NOISE)[0].read().channels
    np.testing.assert_array_equal(volts[:, 2], plain[:, 2])
    assert np.all(volts[:, 1] == 0)


def test_channel_clips_at_its_range():
    channels = [c if c.name != "x.strain" else c.model_copy(update={"range": 0.5}) for c in GEOMETRY.channels]
    geometry = GEOMETRY.model_copy(update={"channels": tuple(channels)})
    volts = simulate_run(true_rig(geometry), STATIC, Noise())[0].read().channels[:, 2]
    assert np.max(volts) == 0.5
    assert np.min(volts) == -0.5


@pytest.mark.parametrize("excitation", ["multisine", "random", "sine-sweep", "stepped"])
def test_excitations_keep_level_and_band(excitation):
    plan = SweepPlan(run="s", excited=("Fx", "My"), level=(40.0, 15.0), excitation=excitation, period=2.0, periods=10)
    run, truth = simulate_run(true_rig(GEOMETRY), plan)
    assert run.period == (2.0 if excitation in ("multisine", "sine-sweep") else None)
    assert run.excited == ("Fx", "My")
    rms = np.sqrt(np.mean(truth.loads**2, axis=0))
    np.testing.assert_allclose(rms[[0, 4]], [40, 15], rtol=0.05)
    assert np.all(truth.loads[:, [1, 2, 3, 5]] == 0)
    power = np.abs(np.fft.rfft(truth.loads[:, 0])) ** 2
    frequency = np.fft.rfftfreq(len(truth.loads), 1 / 800)
    inside = (frequency > 1.5) & (frequency < 150.5)
    assert power[inside].sum() > (0.999 if excitation in ("multisine", "random") else 0.98) * power.sum()
    block = run.read()
    assert np.all(block.loads[:, [COMPONENTS.index(name) for name in ("Fy", "Fz", "Mx", "Mz")]] == 0)


def test_interleaved_lines_do_not_meet():
    plan = SweepPlan(run="s", excited=("Fx", "My"), level=(40.0, 15.0), period=1.0, periods=2)
    loads = simulate_run(true_rig(GEOMETRY), plan)[1].loads
    lines = np.abs(np.fft.rfft(loads[:800, [0, 4]], axis=0)) > 1e-6
    assert lines.sum(0).tolist() == [75, 74]
    assert not np.any(lines.all(axis=1))


def test_turbulence_drift_and_step_act_on_the_loads():
    plan = RotorPlan(
        run="w",
        kind="wind",
        rotor_speed=17.0,
        duration=4.0,
        steady={"Fz": 1000.0},
        turbulence={"Fy": 20.0},
        step={"time": 2.0, "duration": 0.5, "loads": {"Fz": 300.0}},
    )
    loads = simulate_run(true_rig(GEOMETRY), plan)[1].loads
    np.testing.assert_allclose(loads[:1601, 2], 1000)
    np.testing.assert_allclose(loads[2001:, 2], 1300)
    assert np.std(loads[:, 1]) == pytest.approx(20, rel=0.15)


def test_schroeder_phases_make_a_small_peak():
    time = np.arange(8 * 3200) / (8 * 800.0)
    crest = {}
    for phases in ("random", "schroeder"):
        lines = multisine_lines(4.0, (2.0, 150.0), 1.0, np.random.default_rng(3), phases=phases)
        wave = multisine(lines, time)
        amplitude = np.abs(np.fft.rfft(wave))[1:] * 2 / len(wave)
        assert np.sqrt(np.mean(wave**2)) == pytest.approx(1.0, abs=1e-9)
        assert np.ptp(amplitude[7:600]) < 1e-9 and amplitude[600 + 1 :].max() < 1e-9
        crest[phases] = np.abs(wave).max()
    assert crest["schroeder"] < 2.0 < 2.8 < crest["random"]
