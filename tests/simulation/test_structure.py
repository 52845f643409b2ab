"""Effects in the structure and in linear cells: against closed forms, and against rigs that are built that way."""

import numpy as np
import pytest
from scipy.linalg import eigh

from balance_cli.campaign.rig.geometry import Body, Cell
from balance_cli.campaign.rig.rig_scales import rig_frequency
from balance_cli.io.errors import UserError
from balance_cli.model.effects import EFFECTS
from balance_cli.simulation import NO_NOISE, RotorPlan, SweepPlan, simulate_run, true_rig
from balance_cli.simulation.assembly import equations_of_motion
from balance_cli.simulation.extensions.library import EXTENSIONS, extension, parameter_names
from balance_cli.simulation.mechanics import displacement_rows
from balance_cli.simulation.response import state_matrix
from balance_cli.simulation.rig import apply_effects
from tests.support.simulation_rig import GEOMETRY, rig_geometry

UNDAMPED = rig_geometry(damping_ratio=0.0)
LIFT = rig_geometry(freedom=("z",), acquisition={})
LIFT_STIFFNESS, MASS = 20.2e6, 100.0
FREQUENCY = np.arange(2, 151)
S = 2j * np.pi * FREQUENCY


def motion(geometry, *effects, speed=0.0):
    return equations_of_motion(true_rig(geometry).with_extensions(*effects), speed)


def undamped_frequencies(mechanics):
    return np.sqrt(eigh(mechanics.total_stiffness(), mechanics.mass, eigvals_only=True)) / (2 * np.pi)


def lift_response(*effects, geometry=LIFT):
    """Force of cell z1 per Fz (149,), from the last second of a long sweep."""
    plan = SweepPlan(run="s", excited=("Fz",), level=(50.0,), period=1.0, periods=12)
    block = simulate_run(true_rig(geometry).with_extensions(*effects), plan, NO_NOISE)[0].read()
    volts, load = (np.fft.rfft(column[-800:])[FREQUENCY] for column in (block.channels[:, 1], block.loads[:, 2]))
    return volts / load / 0.002 * (1 + S / (2 * np.pi * 90))


def test_plate_on_flexible_support():
    mass, compliance, ratio = 300.0, 1 / 9e6, 0.03
    effect = extension("support-flexibility", ("z",), mass=mass, compliance_z=compliance, damping_ratio=ratio)
    k, d = LIFT_STIFFNESS, 2 * 0.02 * np.sqrt(LIFT_STIFFNESS * MASS)
    ground = 9e6 + 2 * ratio * np.sqrt(9e6 * mass) * S
    # plate and non-metric body in series: the elongation between them for a force on the plate
    low = mass * S**2 + ground
    elongation = low / (MASS * S**2 * (low + d * S + k) + (d * S + k) * low)
    np.testing.assert_allclose(lift_response(effect), 5.1e6 * elongation, rtol=1e-5)


def test_support_that_carries_the_plate_along_stretches_no_cell():
    parameters = {f"compliance_{m}": 1e-7 for m in ("x", "y", "z", "psi", "theta", "phi")}
    parameters |= {"mass": 200.0, "inertia_psi": 20.0, "inertia_theta": 15.0, "inertia_phi": 12.0}
    effects = [
        extension("support-flexibility", ("x", "y", "z", "psi", "theta", "phi"), **parameters),
        extension("cell-misalignment", ("z1",), angle_1=0.02, angle_2=-0.01),
        extension("transverse-stiffness", ("all",), stiffness=1e5),
    ]
    m = motion(GEOMETRY, *effects)
    together = np.zeros((13, 6))
    together[:3] = displacement_rows(m.cg)[:, :]
    together[3:6, 3:] = np.eye(3)
    together[7:] = np.eye(6)
    np.testing.assert_allclose(m.cell_rows @ together, 0, atol=1e-12)
    ground = together.T @ m.total_stiffness() @ together
    np.testing.assert_allclose(ground, 1e7 * np.eye(6), rtol=1e-9, atol=1e-2)
    np.testing.assert_allclose(together.T @ m.damping @ together, 0, atol=1e-7)


def test_hub_on_flexible_mast():
    mass, compliance, ratio = 15.0, 1 / 4e6, 0.01
    geometry = rig_geometry(freedom=("x",), acquisition={})
    effect = extension("mast-bending", ("x",), mass=mass, compliance_x=compliance, damping_ratio=ratio)
    plan = SweepPlan(run="s", excited=("Fx",), level=(50.0,), period=1.0, periods=12)
    block = simulate_run(true_rig(geometry).with_extensions(effect), plan, NO_NOISE)[0].read()
    response = np.divide(*(np.fft.rfft(c[-800:])[FREQUENCY] for c in (block.channels[:, 3], block.loads[:, 0])))
    k = 3e6
    plate = (MASS - mass) * S**2 + 2 * 0.02 * np.sqrt(k * MASS) * S + k
    mast = 4e6 + 2 * ratio * np.sqrt(4e6 * mass) * S
    elongation = mast / ((plate + mast) * (mass * S**2 + mast) - mast**2)
    np.testing.assert_allclose(response / 0.002, k * elongation, rtol=1e-5)


def test_added_mass_is_another_body():
    inertia = {"xx": 0, "yy": 0, "zz": 0}
    body = Body.model_validate({"name": "hose", "mass": 7.0, "position": (0.2, -0.1, 0.3), "inertia": inertia})
    heavier = GEOMETRY.model_copy(update={"bodies": (*GEOMETRY.bodies, body)})
    effect = extension("added-mass", mass=7.0, x=0.2, y=-0.1, z=0.3)
    np.testing.assert_allclose(
        undamped_frequencies(motion(GEOMETRY, effect)), undamped_frequencies(motion(heavier)), rtol=1e-9
    )


def test_the_damping_of_a_plate_follows_an_added_mass_by_its_share():
    inertia = {"xx": 0, "yy": 0, "zz": 0}
    body = Body.model_validate({"name": "hose", "mass": 7.0, "position": (0.2, -0.1, 0.3), "inertia": inertia})
    heavier = equations_of_motion(true_rig(GEOMETRY.model_copy(update={"bodies": (*GEOMETRY.bodies, body)})))
    rows = displacement_rows(np.subtract(motion(GEOMETRY).cg, heavier.cg))
    # From the center of gravity of all bodies to that of the declared ones.
    moved = np.vstack([rows, np.hstack([np.zeros((3, 3)), np.eye(3)])])
    at = {"mass": 7.0, "x": 0.2, "y": -0.1, "z": 0.3}
    stays, half, follows = (motion(GEOMETRY, extension("added-mass", damping_share=c, **at)) for c in (0.0, 0.5, 1.0))
    np.testing.assert_allclose(moved.T @ follows.damping[:6, :6] @ moved, heavier.damping[:6, :6], rtol=1e-7, atol=1e-6)
    np.testing.assert_allclose(stays.damping, motion(GEOMETRY).damping)
    np.testing.assert_allclose(half.damping, (stays.damping + follows.damping) / 2)


def test_every_effect_is_simulated_with_all_its_parameters():
    for effect in EFFECTS:
        if effect.name in EXTENSIONS:
            kind = EXTENSIONS[effect.name]
            for where in effect.places(GEOMETRY)[:1]:
                names = {item.name for item in effect.parameters(GEOMETRY, where)}
                assert names <= set(parameter_names(kind)), effect.name


def test_springs_beside_the_cells_are_cells_without_channels():
    path = [
        Cell(name=f"p{i}", position=(0.1, 0.2, 0.3), axis=axis, stiffness=k, full_range=1)
        for i, (axis, k) in enumerate([((1, 0, 0), 1e5), ((0, 1, 0), 2e5), ((0, 0, 1), 3e5)])
    ]
    stiffer = UNDAMPED.model_copy(update={"cells": (*UNDAMPED.cells, *path)})
    springs = {"stiffness_x": 1e5, "stiffness_y": 2e5, "stiffness_z": 3e5}
    hose = motion(UNDAMPED, extension("parallel-stiffness", x=0.1, y=0.2, z=0.3, **springs))
    np.testing.assert_allclose(hose.total_stiffness(), motion(stiffer).total_stiffness(), rtol=1e-12)
    z1 = UNDAMPED.cells[3]
    across = [
        z1.model_copy(update={"name": n, "axis": a, "stiffness": 1e5}) for n, a in (("a", (1, 0, 0)), ("b", (0, 1, 0)))
    ]
    stiffer = UNDAMPED.model_copy(update={"cells": (*UNDAMPED.cells, *across)})
    flexure = motion(UNDAMPED, extension("transverse-stiffness", ("z1",), stiffness=1e5))
    np.testing.assert_allclose(flexure.total_stiffness(), motion(stiffer).total_stiffness(), rtol=1e-12)


@pytest.mark.parametrize(
    ("cell", "axis"), [("x", (1, 0.02, -0.03)), ("y1", (-0.03, 1, 0.02)), ("z2", (0.02, -0.03, 1))]
)
def test_misaligned_cell_is_a_cell_with_another_axis(cell, axis):
    cells = [c.model_copy(update={"axis": axis}) if c.name == cell else c for c in UNDAMPED.cells]
    askew = UNDAMPED.model_copy(update={"cells": tuple(cells)})
    m = motion(UNDAMPED, extension("cell-misalignment", (cell,), angle_1=0.02, angle_2=-0.03))
    np.testing.assert_allclose(m.cell_rows, motion(askew).cell_rows, atol=1e-12)
    np.testing.assert_allclose(m.total_stiffness(), motion(askew).total_stiffness(), rtol=1e-12)


def test_spinning_rotor_splits_the_tilt_modes():
    """A symmetrical top: `omega^2 -+ (I_p Omega / I) omega - k / I = 0`; the forward whirl is the faster."""
    cells = [
        Cell(name=f"z{i}", position=(x, y, 0), axis=(0, 0, 1), stiffness=1e6, full_range=1)
        for i, (x, y) in enumerate([(0.3, 0.3), (-0.3, 0.3), (-0.3, -0.3), (0.3, -0.3)])
    ]
    body = Body.model_validate({"name": "b", "mass": 50, "position": (0, 0, 0), "inertia": {"xx": 4, "yy": 4, "zz": 5}})
    channels = [{"name": "c", "cell": "z0", "sensitivity": 1.0}]
    geometry = rig_geometry(
        bodies=[body], cells=cells, channels=channels, freedom=("theta", "phi"), damping_ratio=0.0, torque_meter=None
    )
    spin, polar = 20.0, 1.5
    m = motion(geometry, extension("gyroscopic-coupling", polar_inertia=polar), speed=spin)
    poles, shapes = np.linalg.eig(state_matrix(m))
    split = polar * 2 * np.pi * spin / 4.0
    k = 4 * 1e6 * 0.3**2 / 4.0
    expected = np.array([-split / 2, split / 2]) + np.sqrt(split**2 / 4 + k)
    rising = np.argsort(poles.imag)[2:]
    np.testing.assert_allclose(poles.imag[rising], expected, rtol=1e-9)
    theta, phi = shapes[:2, rising[1]]
    # the axis of the top points to (theta, -phi): with the spin its y follows its x by a quarter turn
    assert np.imag(-phi / theta) == pytest.approx(-1.0)
    assert np.all(motion(geometry, extension("gyroscopic-coupling", polar_inertia=polar)).damping == 0)


def test_structural_damping_has_its_loss_factor_and_shows_in_the_force():
    geometry = rig_geometry(freedom=("z",), acquisition={}, damping_ratio=0.0)
    eta = 0.04
    response = lift_response(extension("structural-damping", ("all",), loss_factor=eta), geometry=geometry)
    # force / load = k(s) / (m s^2 + k(s)) per cell: solve for k(s)
    share = response * LIFT_STIFFNESS / 5.1e6
    stiffness = MASS * S**2 * share / (1 - share)
    np.testing.assert_allclose((stiffness.imag / LIFT_STIFFNESS)[3:], eta, rtol=0.06)
    declared = np.interp(rig_frequency(geometry), FREQUENCY, stiffness.real)
    assert declared == pytest.approx(LIFT_STIFFNESS, rel=2e-3)
    growth = np.diff(stiffness.real[[3, 98]])[0] / LIFT_STIFFNESS
    assert growth == pytest.approx(2 / np.pi * eta * np.log(100 / 5), rel=0.06)


def test_effects_act_in_the_order_of_the_list():
    support = extension("support-flexibility", ("x",), mass=100.0, compliance_x=1e-8)
    askew = extension("cell-misalignment", ("x",), angle_1=0.1)
    one, other = (apply_effects(true_rig(GEOMETRY), e).extensions for e in ((askew, support), (support, askew)))
    assert one == other == (support, askew)


def test_gyroscopic_rig_runs_at_speed_with_nonlinear_cell():
    rig = true_rig(GEOMETRY).with_extensions(
        extension("gyroscopic-coupling", polar_inertia=0.5), extension("cubic-stiffness", ("z1",), k3=1e13)
    )
    plan = RotorPlan(run="c", rotor_speed=17.5, duration=0.5, harmonics={"Fz": (50.0,)})
    assert np.all(np.isfinite(simulate_run(rig, plan)[0].read().channels))


def test_impossible_effects_are_refused():
    with pytest.raises(UserError, match="mass or inertia"):
        motion(
            GEOMETRY,
            extension("support-flexibility", ("x", "theta"), mass=10.0, compliance_x=1e-8, compliance_theta=1e-8),
        )
    with pytest.raises(UserError, match="needs a mass"):
        motion(GEOMETRY, extension("mast-bending", ("x",), compliance_x=1e-8))
    with pytest.raises(UserError, match="not at psi"):
        motion(GEOMETRY, extension("mast-bending", ("psi",), mass=1.0, compliance_x=1e-8))
