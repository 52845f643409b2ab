"""Nonlinear cells in the simulation against scipy's general integrator, and by hand at rest."""

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.io.errors import UserError
from balance_cli.simulation import (
    NO_NOISE,
    CampaignPlan,
    RotorPlan,
    StaticPlan,
    simulate_campaign,
    simulate_run,
    true_rig,
)
from balance_cli.simulation.assembly import equations_of_motion
from balance_cli.simulation.extensions.library import extension
from balance_cli.simulation.rig import apply_effects
from tests.support.simulation_rig import GEOMETRY, rig_geometry

ONE_DOF = Path(__file__).parents[2] / "configs" / "one-dof.yaml"
Z1 = 3
OPEN = rig_geometry(acquisition={})
PLAN = RotorPlan(
    run="c",
    rotor_speed=17.5,
    duration=0.3,
    harmonics={"Fz": (300.0, 100.0, 0.0, 200.0), "Mx": (40.0,)},
    steady={"Fz": 400.0},
)


def reference(rig, truth, extra_force, contact=(0.0, 0.0)):
    """Elongation of cell z1 and its contact's force (samples,), by DOP853 from the same rest."""
    m = equations_of_motion(rig)
    K, row = m.total_stiffness(), m.cell_rows[Z1]
    n = m.size
    stick, limit = contact

    def loads(t):
        angle = 2 * np.pi * 17.5 * t * np.arange(9)
        return np.cos(angle) @ truth.cosine + np.sin(angle) @ truth.sine

    def rates(t, x):
        q, v, held = x[:n], x[n:-1], x[-1]
        force = m.loads @ loads(t) - m.damping @ v - K @ q - row * (extra_force(row @ q) + held)
        slides = abs(held) >= limit and held * (row @ v) > 0
        return np.concatenate([v, np.linalg.solve(m.mass, force), [0.0 if slides else stick * (row @ v)]])

    q = np.zeros(n)
    for _ in range(200):
        held = np.clip(stick * (row @ q), -limit, limit)
        q = np.linalg.solve(K, m.loads @ loads(0.0) - row * (extra_force(row @ q) + held))
    start = np.concatenate([q, np.zeros(n), [np.clip(stick * (row @ q), -limit, limit)]])
    solution = solve_ivp(rates, (0, truth.time[-1]), start, "DOP853", truth.time, rtol=1e-9, atol=1e-13, max_step=2e-4)
    return solution.y[:n].T @ row, solution.y[-1], solution.y[:n].T @ m.cell_rows[0]


@pytest.mark.parametrize("side", ["inside", "beside"])
@pytest.mark.parametrize(
    ("name", "key", "value", "power"), [("cubic-stiffness", "k3", 2e14, 3), ("quadratic-stiffness", "k2", 2e9, 2)]
)
def test_polynomial_springs_against_general_integrator(name, key, value, power, side):
    channels = [c if c.lowpass is None else c.model_copy(update={"lowpass": None}) for c in OPEN.channels]
    rig = true_rig(OPEN.model_copy(update={"channels": tuple(channels)}))
    rig = rig.with_extensions(extension(name, ("z1",), **{key: value, "side": side}))
    run, truth = simulate_run(rig, PLAN, NO_NOISE)
    d, _, dx = reference(rig, truth, lambda e: value * e**power)
    felt = value * d**power if side == "inside" else 0.0
    expected = 0.002 * (5.1e6 * d + felt)
    assert np.max(np.abs(value * d**power)) > 0.03 * np.max(np.abs(5.1e6 * d))
    volts = run.read().channels
    assert np.max(np.abs(volts[:, 1] - expected)) < 1e-5 * np.max(np.abs(expected))
    assert np.max(np.abs(volts[:, 3] - 0.002 * 3e6 * dx)) < 1e-5 * np.max(np.abs(0.002 * 3e6 * dx))


def test_a_hardening_spring_of_a_rig_with_a_single_mode_against_general_integrator():
    """m x'' + d x' + k x + k3 x^3 = F: with one mode each of its states would show in the newest force."""
    k3 = 2e11
    rig = true_rig(load_geometry(ONE_DOF)).with_extensions(extension("cubic-stiffness", ("z",), k3=k3, side="beside"))
    plan = RotorPlan(run="c", rotor_speed=6.0, duration=1.0, harmonics={"Fz": (60.0, 30.0, 40.0)})
    run, truth = simulate_run(rig, plan, NO_NOISE)
    m = equations_of_motion(rig)
    (mass,), (damping,), (stiffness,) = (matrix.ravel() for matrix in (m.mass, m.damping, m.total_stiffness()))
    row = float(m.cell_rows[0, 0])

    def load(t):
        angle = 2 * np.pi * 6.0 * t * np.arange(truth.cosine.shape[0])
        return float(m.loads[0] @ (np.cos(angle) @ truth.cosine + np.sin(angle) @ truth.sine))

    def rates(t, x):
        return [x[1], (load(t) - damping * x[1] - stiffness * x[0] - row * k3 * (row * x[0]) ** 3) / mass]

    rest = brentq(lambda q: stiffness * q + row * k3 * (row * q) ** 3 - load(0.0), -1e-2, 1e-2, xtol=1e-18)
    solution = solve_ivp(
        rates, (0, truth.time[-1]), [rest, 0.0], "DOP853", truth.time, rtol=1e-10, atol=1e-14, max_step=1e-3
    )
    d = row * solution.y[0]
    assert np.max(k3 * np.abs(d) ** 3) > 0.03 * np.max(4.0e5 * np.abs(d))
    expected = 0.01 * 4.0e5 * d
    assert np.max(np.abs(run.read().channels[:, 0] - expected)) < 1e-5 * np.max(np.abs(expected))


def test_slipping_contact_against_general_integrator():
    rig = true_rig(OPEN).with_extensions(extension("dry-friction", ("z1",), force=12.0, stick_stiffness=1e6))
    run, truth = simulate_run(rig, PLAN, NO_NOISE)
    _, held, dx = reference(rig, truth, lambda e: 0.0, (1e6, 12.0))
    assert np.max(held) > 11.999
    assert np.min(held) < -11.999
    expected = 0.002 * 3e6 * dx
    error = run.read().channels[:, 3] - expected
    assert np.max(np.abs(error)) < 1e-4 * np.max(np.abs(expected))


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("cubic-stiffness", {"k3": 1e14, "side": "beside"}),
        ("dry-friction", {"force": 2.0, "stick_stiffness": 1e6}),
        ("stribeck-friction", {"force": 2.0, "static_force": 4.0, "speed": 1e-3, "stick_stiffness": 1e6}),
        ("quadratic-damping", {"c2": 1e5}),
    ],
)
def test_blocks_of_steps_are_the_steps_one_by_one(monkeypatch, name, values):
    """Of an elongation and of its rate, in records of two lengths; the reference is the way of many forces."""
    rig = true_rig(GEOMETRY).with_extensions(extension(name, ("z1",), **values))
    plan = CampaignPlan(runs=(PLAN, PLAN.model_copy(update={"run": "d", "duration": 0.401})))
    in_blocks, _ = simulate_campaign(rig, plan, NO_NOISE)
    monkeypatch.setattr("balance_cli.simulation.nonlinear.MOST_SINGLE_RUNS", 0)
    step_by_step, _ = simulate_campaign(rig, plan, NO_NOISE)
    for one, other in zip(in_blocks, step_by_step, strict=True):
        np.testing.assert_allclose(one.read().channels, other.read().channels, rtol=0.0, atol=1e-11)


def test_runs_together_are_the_runs_alone():
    rig = true_rig(GEOMETRY).with_extensions(
        extension("dry-friction", ("x",), force=2.0, stick_stiffness=1e6),
        extension("cubic-stiffness", ("z1", "z2"), k3=1e14),
    )
    longer = PLAN.model_copy(update={"run": "d", "duration": 0.4, "rotor_speed": 16.0})
    runs, _ = simulate_campaign(rig, CampaignPlan(runs=(PLAN, longer)))
    for plan, run in zip((PLAN, longer), runs, strict=True):
        alone, _ = simulate_run(rig, plan)
        np.testing.assert_allclose(run.read().channels, alone.read().channels, atol=1e-12)


def test_contact_leaves_a_loop_in_the_static_calibration():
    geometry = rig_geometry(freedom=("x",))
    rig = true_rig(geometry).with_extensions(extension("dry-friction", ("x",), force=30.0, stick_stiffness=1e6))
    plan = StaticPlan(run="s", largest={"Fx": 800.0}, steps=4)
    run, _ = simulate_run(rig, plan, NO_NOISE)
    cell = run.read().channels[:, 2] / 0.002
    k, stick, limit = 3e6, 1e6, 30.0
    expected, d, held = [], 0.0, 0.0
    for load in np.array([0, 1, 2, 3, 4, 3, 2, 1, 0, -1, -2, -3, -4, -3, -2, -1, 0]) * 200.0:
        stuck = (load + stick * d - held) / (k + stick)
        moved = held + stick * (stuck - d)
        held = np.clip(moved, -limit, limit)
        d = (load - held) / k if abs(moved) > limit else stuck
        expected.append(k * d)
    np.testing.assert_allclose(cell, expected, atol=1e-8)
    assert cell[5] - cell[3] == pytest.approx(50.0)


def test_cubic_spring_at_rest_obeys_its_law():
    geometry = rig_geometry(freedom=("x",))
    rig = true_rig(geometry).with_extensions(extension("cubic-stiffness", ("x",), k3=1e13, side="beside"))
    run, truth = simulate_run(rig, StaticPlan(run="s", largest={"Fx": 800.0}), NO_NOISE)
    d = run.read().channels[:, 2] / 0.002 / 3e6
    np.testing.assert_allclose(3e6 * d + 1e13 * d**3, truth.loads[:, 0], atol=1e-7)


def test_faults_name_the_nearest():
    rig = true_rig(GEOMETRY)
    with pytest.raises(UserError, match="cubic-stiffness"):
        apply_effects(rig, [DeclaredEffect(name="cubic-stifness", where=("z1",))])
    with pytest.raises(UserError, match="Did you mean `k3`"):
        apply_effects(rig, [DeclaredEffect(name="cubic-stiffness", where=("z1",), parameters={"k33": 1.0})])
    with pytest.raises(UserError, match="not at z9"):
        declared = DeclaredEffect(name="cubic-stiffness", where=("z9",), parameters={"k3": 1.0})
        equations_of_motion(apply_effects(rig, [declared]))
    with pytest.raises(UserError, match="`sideways`"):
        equations_of_motion(rig.with_extensions(extension("cubic-stiffness", ("z1",), k3=1.0, side="sideways")))
    with pytest.raises(UserError, match="not a number"):
        extension("time-delay", ("torque",), delay="long")


def test_forces_inside_and_beside_one_cell_are_two():
    """A search may accept both; one of the two twice is a mistake."""
    sides = [
        DeclaredEffect(name="quadratic-stiffness", where=("z1",), parameters={"k2": k2, "side": side})
        for k2, side in ((1e8, "inside"), (2e8, "beside"))
    ]
    rig = apply_effects(true_rig(GEOMETRY), sides)
    assert [item.side for item in rig.extensions] == ["inside", "beside"]
    with pytest.raises(UserError, match="`quadratic-stiffness@z1` is given twice"):
        apply_effects(true_rig(GEOMETRY), [*sides, sides[0]])
