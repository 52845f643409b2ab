"""The simulated linear rig against formulas written down anew, and against scipy's general integrator."""

import numpy as np
import pytest
from scipy import signal
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

from balance_cli.io.errors import UserError
from balance_cli.simulation import (
    NO_NOISE,
    Noise,
    RotorPlan,
    StaticPlan,
    SweepPlan,
    draw_rig,
    short_plan,
    simulate_campaign,
    simulate_run,
    standard_plan,
    true_rig,
)
from balance_cli.simulation.assembly import equations_of_motion
from balance_cli.simulation.rig import metric_side
from tests.support.simulation_rig import GEOMETRY, rig_geometry


def expected_matrices(geometry):
    """M, K, cell rows and load columns by moving a rigid body about: an independent way to the same equations."""

    def motion(q, point, cg):
        return q[:3] + np.cross([q[5], q[4], q[3]], np.subtract(point, cg))

    mass = sum(b.mass for b in geometry.bodies)
    cg = sum(b.mass * np.array(b.position) for b in geometry.bodies) / mass
    M = np.zeros((6, 6))
    for b in geometry.bodies:
        J = np.array([motion(e, b.position, cg) for e in np.eye(6)]).T
        W = np.array([[e[5], e[4], e[3]] for e in np.eye(6)]).T
        i = b.inertia
        tensor = np.array([[i.xx, -i.xy, -i.xz], [-i.xy, i.yy, -i.yz], [-i.xz, -i.yz, i.zz]])
        M += b.mass * J.T @ J + W.T @ tensor @ W
    rows = np.array([[np.dot(motion(e, c.position, cg), c.axis) for e in np.eye(6)] for c in geometry.cells])
    rows = rows / np.linalg.norm([c.axis for c in geometry.cells], axis=1)[:, None]
    stiffness = np.array([c.stiffness or c.series[0] / 2 for c in geometry.cells])
    F = np.array([[*motion(e, geometry.hub, cg), e[5], e[4], 0.0] for e in np.eye(6)])
    return M, rows.T @ np.diag(stiffness) @ rows, rows, stiffness, F


def expected_response(geometry, frequency, component):
    """Volts per load (k, channels) at `frequency` (k,) [Hz], before the anti-alias filter."""
    M, K, rows, c, F = expected_matrices(geometry)
    free = ["x", "y", "z", "psi", "theta", "phi"]
    keep = [free.index(name) for name in free if name in geometry.freedom]
    M, K, rows, F = M[np.ix_(keep, keep)], K[np.ix_(keep, keep)], rows[:, keep], F[keep]
    squares, modes = eigh(K, M)
    s = 2j * np.pi * np.asarray(frequency)
    modal = (modes.T @ F[:, component]) / (s[:, None] ** 2 + 0.04 * s[:, None] * np.sqrt(squares) + squares)
    force = modal @ modes.T @ rows.T * c
    twist = (component == 5) * 9e4 / (0.65 * s**2 + 0.04 * np.sqrt(9e4 * 0.65) * s + 9e4)
    strain = force[:, 3] * 0.002 / (1 + s / (2 * np.pi * 90))
    return np.stack([0.02 * twist, strain, -0.01 * force[:, 2] * 0.1 * s / (1 + 0.1 * s), 0.002 * force[:, 0]], axis=1)


def line_amplitudes(samples, periods, numbers):
    """Complex amplitudes at lines of the last period of `periods` in the samples (n, s)."""
    count = len(samples) // periods
    return np.fft.rfft(samples[-count:], axis=0)[numbers] * 2 / count


@pytest.mark.parametrize(("component", "freedom"), [(0, None), (4, None), (5, None), (2, ("z", "theta"))])
def test_multisine_reaches_the_closed_form_steady_state(component, freedom):
    geometry = rig_geometry(**({"freedom": freedom} if freedom else {}))
    name = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")[component]
    plan = SweepPlan(run="s", excited=(name,), level=(30.0,), period=2.0, periods=8)
    run, truth = simulate_run(true_rig(geometry), plan, NO_NOISE)
    numbers = np.arange(4, 301)
    frequency = numbers / 2.0
    X = line_amplitudes(truth.loads[:, component], 8, numbers)
    np.testing.assert_allclose(np.abs(X), 30 * np.sqrt(2 / 297), rtol=1e-9)
    butterworth = signal.freqs(*signal.butter(5, 2 * np.pi * 180, analog=True), 2 * np.pi * frequency)[1]
    block = run.read()
    loads = line_amplitudes(block.loads, 8, numbers)
    np.testing.assert_allclose(loads[:, component], X * butterworth, rtol=1e-6)
    expected = expected_response(geometry, frequency, component) * (X * butterworth)[:, None]
    got = line_amplitudes(block.channels, 8, numbers)
    scale = np.maximum(np.abs(expected), 1e-6 * np.abs(expected).max() + 1e-12)
    assert np.max(np.abs(got - expected) / scale) < 1e-5


def test_start_from_equilibrium_matches_general_integrator():
    plan = RotorPlan(run="c", rotor_speed=17.5, duration=0.4, harmonics={"Fz": (50.0, 20.0), "Mx": (10.0,)})
    rig = true_rig(rig_geometry(acquisition={}))
    run, truth = simulate_run(rig, plan, NO_NOISE, seed=3)
    m = equations_of_motion(rig)
    c, s = truth.cosine, truth.sine
    K = m.total_stiffness()

    def loads(t):
        n = 2 * np.pi * 17.5 * t * np.arange(9)
        return np.cos(n) @ c + np.sin(n) @ s

    def motion(t, x):
        return np.concatenate([x[7:], np.linalg.solve(m.mass, m.loads @ loads(t) - m.damping @ x[7:] - K @ x[:7])])

    start = np.concatenate([np.linalg.solve(K, m.loads @ loads(0.0)), np.zeros(7)])
    solution = solve_ivp(motion, (0, 0.4), start, "DOP853", truth.time, rtol=1e-10, atol=1e-14)
    expected = 0.002 * 3.0e6 * solution.y[:7].T @ m.cell_rows[0]
    got = run.read().channels[:, 3]
    assert np.max(np.abs(got - expected)) < 1e-6 * np.max(np.abs(expected))


def test_metric_side_and_damping_of_each_mode():
    M, K, *_ = expected_matrices(GEOMETRY)
    ratios = [0.01, 0.02, 0.03, 0.04, 0.05, 0.06]
    m = equations_of_motion(true_rig(GEOMETRY, damping_ratios=ratios, torque_damping_ratio=0.07))
    np.testing.assert_allclose(m.mass[:6, :6], M, atol=1e-12)
    np.testing.assert_allclose(m.total_stiffness()[:6, :6], K, rtol=1e-10, atol=1e-6)
    squares, modes = eigh(K, M)
    np.testing.assert_allclose(modes.T @ m.damping[:6, :6] @ modes, np.diag(2 * np.sqrt(squares) * ratios), atol=1e-9)
    assert m.damping[6, 6] == pytest.approx(2 * 0.07 * np.sqrt(9e4 * 0.65))
    mass, cg, _ = metric_side(GEOMETRY)
    assert mass == 100
    np.testing.assert_allclose(cg, [-0.02, 0.008, 0.16])


def test_static_forces_balance_the_loads():
    plan = StaticPlan(run="s", largest={"Fx": 800.0, "Mz": 450.0}, trim_loads={"Fz": 2500.0}, steps=5)
    run, truth = simulate_run(true_rig(GEOMETRY), plan, NO_NOISE)
    assert run.channel_names == ("torque", "z1.strain", "x.strain")
    steps = [0, 1, 2, 3, 4, 5, 4, 3, 2, 1, 0, -1, -2, -3, -4, -5, -4, -3, -2, -1, 0]
    np.testing.assert_allclose(truth.loads[:21, 0], np.array(steps) * 160.0)
    assert np.all(truth.loads[:, 2] == 2500)
    volts = run.read().channels
    np.testing.assert_allclose(volts[:, 2], 0.002 * truth.loads[:, 0], atol=1e-12)
    np.testing.assert_allclose(volts[:, 0], 0.02 * truth.loads[:, 5], atol=1e-12)
    noisy = simulate_run(true_rig(GEOMETRY), plan, Noise())[0].read()
    assert np.all((noisy.loads != 0) == (truth.loads != 0))
    assert np.std(noisy.loads[:, 2]) == pytest.approx(0.05, rel=0.4)


def test_noise_is_white_and_as_declared():
    plan = SweepPlan(run="s", excited=("Fx",), level=(30.0,), period=4.0, periods=3)
    clean, noisy = (simulate_run(true_rig(GEOMETRY), plan, noise)[0].read() for noise in (NO_NOISE, Noise()))
    added = noisy.channels - clean.channels
    np.testing.assert_allclose(np.std(added, axis=0), [2e-3, 1e-3, 1.5e-3, 1e-3], rtol=0.03)
    spectrum = np.abs(np.fft.rfft(added, axis=0)) ** 2
    half = len(spectrum) // 2
    np.testing.assert_allclose(spectrum[1:half].mean(0) / spectrum[half:].mean(0), 1, atol=0.08)
    assert np.std(noisy.loads - clean.loads, axis=0)[0] == pytest.approx(0.02, rel=0.03)
    assert np.all(noisy.loads[:, 1:] == 0)
    steps = noisy.channels / (20 / 2**16)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)


def test_campaign_repeats_and_runs_are_independent():
    whole = short_plan().select_runs(["sweep-Fx", "check-1", "static-bare"])
    plan = whole.model_copy(update={"runs": (*whole.runs[:2], whole.runs[2].model_copy(update={"duration": 2.0}))})
    rig = true_rig(GEOMETRY)
    runs, truths = simulate_campaign(rig, plan, seed=5)
    alone = simulate_campaign(rig, plan.select_runs(["check-1"]), seed=5).runs[0]
    again = next(run for run in runs if run.name == "check-1")
    np.testing.assert_array_equal(alone.read().channels, again.read().channels)
    assert alone.digest == again.digest
    other = simulate_campaign(rig, plan.select_runs(["check-1"]), seed=6).runs[0]
    assert np.max(np.abs(other.read().channels - alone.read().channels)) > 0.01
    quiet = simulate_campaign(rig, plan.select_runs(["check-1"]), NO_NOISE, seed=5).truths[0]
    np.testing.assert_array_equal(quiet.loads, next(t for t in truths if t.name == "check-1").loads)
    assert quiet.cosine is not None
    assert quiet.sine is not None
    assert np.all(quiet.cosine[:, [0, 1, 3, 5]] == 0)


def test_drifting_rotor_keeps_loads_at_the_azimuth_of_the_pulses():
    plan = RotorPlan(
        run="w",
        kind="wind",
        rotor_speed=17.0,
        duration=12.0,
        drift=0.03,
        harmonics={"Fz": (10.0,)},
        steady={"Fz": 99.0},
    )
    run, truth = simulate_run(true_rig(GEOMETRY), plan, NO_NOISE)
    assert not run.has_loads
    assert run.read().loads is None
    pulses = run.pulse_times
    assert np.all(np.diff(pulses) > 0.05)
    assert 0 < pulses[0] < 0.07
    at_pulse = np.interp(pulses, truth.time, truth.azimuth)
    np.testing.assert_allclose(at_pulse, 2 * np.pi * np.arange(1, len(pulses) + 1), atol=1e-4)
    expected = 99 + truth.cosine[1, 2] * np.cos(truth.azimuth) + truth.sine[1, 2] * np.sin(truth.azimuth)
    np.testing.assert_allclose(truth.loads[:, 2], expected, atol=1e-9)


def test_drawn_rigs_scatter_as_declared_and_stay_possible():
    rng = np.random.default_rng(1)
    rigs = [draw_rig(GEOMETRY, rng) for _ in range(400)]
    declared = true_rig(GEOMETRY)
    for name, tolerance in (("mass", 0.02), ("stiffness", 0.05), ("torque_stiffness", 0.05), ("sensitivities", 0.01)):
        spread = np.std([getattr(r, name) / getattr(declared, name) for r in rigs], axis=0)
        np.testing.assert_allclose(spread, tolerance, rtol=0.2)
    np.testing.assert_allclose(np.std([r.cg for r in rigs], axis=0), 0.005, rtol=0.2)
    product = np.std([r.inertia[0, 2] for r in rigs])
    assert product == pytest.approx(0.1 * np.sqrt(declared.inertia[0, 0] * declared.inertia[2, 2]), rel=0.2)
    assert min(np.min(r.damping_ratios) for r in rigs) > 0
    assert np.std([r.damping_ratios for r in rigs]) == pytest.approx(0.01, rel=0.15)


def test_rig_that_cannot_stand_is_refused():
    cells = GEOMETRY.cells[:3]
    channels = [{"name": "c", "cell": "x", "sensitivity": 1.0}]
    with pytest.raises(UserError, match="do not hold every degree of freedom"):
        equations_of_motion(true_rig(rig_geometry(cells=cells, channels=channels)))


def test_standard_plan_has_the_runs_of_the_recorded_campaign():
    kinds = [run.kind for run in standard_plan().runs]
    assert {kind: kinds.count(kind) for kind in kinds} == {"static": 2, "sweep": 12, "check": 3, "wind": 3}
