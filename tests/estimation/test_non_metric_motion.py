"""Cells and loads show the motion of the side that the cells stand on, and the modes of a body there."""

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.campaign.rig.rig_scales import inertia_by_motion, stiffness_by_motion
from balance_cli.estimation.measurements import stack_runs
from balance_cli.estimation.non_metric_motion import SCAN_STEP, body_modes, non_metric_motion
from balance_cli.model.balance import balance_model
from balance_cli.model.modes import modes
from tests.support.model_lines import model_lines
from tests.support.rigs import two_degrees_of_freedom

RIG = two_degrees_of_freedom()
CENTER = (0.02, 0.0, -0.3)


def support(heavier, softer):
    inertia, stiffness = inertia_by_motion(RIG), stiffness_by_motion(RIG)
    return {
        "mass": heavier * inertia["z"],
        "inertia_theta": heavier * inertia["theta"],
        "compliance_z": softer / stiffness["z"],
        "compliance_theta": 2.0 * softer / stiffness["theta"],
    }


def lines_with(parameters):
    """Sweeps of a rig on a body with these parameters, nearly without noise."""
    where, others = ("z", "theta"), {"damping_ratio": 0.01, "x": CENTER[0], "z": CENTER[2]}
    effect = DeclaredEffect(name="support-flexibility", where=where, parameters={**parameters, **others})
    model, rng = balance_model(RIG.model_copy(update={"effects": (effect,)})), np.random.default_rng(5)
    rigid = balance_model(RIG)
    frequency = np.linspace(0.05, 2.0, 200) * modes(rigid.at().system()).frequency.min()
    runs = [model_lines(model, name, i, frequency, 1e-6, rng) for name, i in (("Fz", 2), ("My", 4))]
    return stack_runs(runs, (), RIG.channel_names)


@pytest.mark.parametrize(("heavier", "softer"), [(1.0, 1.0), (8.0, 0.3), (3.0, 4.0)])
def test_the_modes_of_a_body_are_those_of_its_motion(heavier, softer):
    """At its center each motion is a mass on a spring: its frequency to the step of the scan, and its inertia."""
    truth = support(heavier, softer)
    motion = non_metric_motion(lines_with(truth), balance_model(RIG).at().system(derivatives=False), len(RIG.cells))
    found = body_modes(motion.at(np.array(CENTER)), ("z", "theta"))
    for name, inertia in (("z", truth["mass"]), ("theta", truth["inertia_theta"])):
        compliance = truth[f"compliance_{name}"]
        own = 1.0 / (2 * np.pi * np.sqrt(inertia * compliance))
        assert found[name].frequency == pytest.approx(own, rel=SCAN_STEP), name
        assert found[name].explained > 0.8
        assert found[name].inertia == pytest.approx(inertia, rel=0.3), name


def test_the_motion_and_the_forces_do_the_same_work_at_each_point():
    motion = non_metric_motion(
        lines_with(support(2.0, 0.5)), balance_model(RIG).at().system(derivatives=False), len(RIG.cells)
    )
    elsewhere = motion.at(np.array([0.3, -0.2, 0.7]))
    work = np.sum(motion.forces.conj() * motion.motion, axis=1)
    np.testing.assert_allclose(np.sum(elsewhere.forces.conj() * elsewhere.motion, axis=1), work, rtol=1e-9)
    back = elsewhere.at(motion.point)
    np.testing.assert_allclose(back.motion, motion.motion, rtol=1e-9, atol=1e-12 * np.abs(motion.motion).max())


def test_a_rigid_side_does_not_move():
    motion = non_metric_motion(
        lines_with(support(1.0, 0.0)), balance_model(RIG).at().system(derivatives=False), len(RIG.cells)
    )
    assert np.abs(motion.motion).max() < 1e-3 * np.abs(motion.relative).max()


def test_cells_that_do_not_determine_the_motion_show_none():
    """Without the channel of one of two cells there is heave or pitch; static lines alone show no motion."""
    one = RIG.model_copy(update={"channels": RIG.channels[:1]})
    model = balance_model(one)
    runs = [model_lines(model, "Fz", 2, np.linspace(5.0, 50.0, 20), 1e-6, np.random.default_rng(5))]
    system = model.at().system(derivatives=False)
    assert non_metric_motion(stack_runs(runs, (), one.channel_names), system, len(one.cells)) is None
    assert non_metric_motion((), system, len(one.cells)) is None
