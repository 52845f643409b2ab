"""How far a mass that no channel shows changes the loads, against loads of rigs that have it."""

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.reduction.reliability import UndeclaredMass
from balance_cli.reduction.undeclared_mass import join_harmonics_of_masses
from balance_cli.steps.reduce import ReduceOptions, reduce_run
from tests.reduction.test_suspect_channels import computed
from tests.support.other_rigs import other_rig
from tests.support.wind_record import wind_record

RIG = other_rig("B")
HARMONICS = 4
LOADS = np.array([[30.0, 20.0, 200.0, 3.0, 4.0, 2.0]] + [[20.0, 15j, 30.0, 3j, 4.0, 2.0]] * HARMONICS, complex)


class WithoutMotion:
    """The response of a model as that of measured responses: without equations of motion."""

    system = None

    def __init__(self, source):
        self._source = source

    def __getattr__(self, name):
        return getattr(self._source, name)

    def remove_nonlinear_contribution(self, run, live):
        return run


def reduced(rig, source):
    run = wind_record(rig, LOADS, seconds=3.0, noise=1e-6).run
    return reduce_run(run, RIG, None, source, None, ReduceOptions(harmonics=HARMONICS))


def with_mass(mass, position):
    values = dict(zip("xyz", position, strict=True))
    added = DeclaredEffect(name="added-mass", where=(), parameters={"mass": mass, **values})
    return RIG.model_copy(update={"effects": (added,)})


@pytest.fixture(scope="module")
def source():
    return computed(RIG)[1]


def test_loads_change_by_what_is_stated_and_no_channel_shows_it(source):
    """A mass at the hub: x of the run follows from the wrong loads exactly, by the response that gave them."""
    mass = 0.01 * sum(body.mass for body in RIG.bodies)
    loads = reduced(with_mass(mass, RIG.hub), source)
    assert not any("redundancy" in flag for row in loads.flags for flag in row)
    error, stated = np.abs(loads.amplitude - LOADS)[1:], loads.undeclared_mass
    assert stated.mass == pytest.approx(mass) and np.all(stated.change > 0.999 * error - 1e-5)
    at_hub = stated.place == 0
    assert np.count_nonzero(at_hub[:, :3]) > 6
    np.testing.assert_allclose(stated.change[at_hub], error[at_hub], rtol=1e-3, atol=1e-5)
    assert "sigma) if at the hub" in loads.undeclared_mass_note


def test_a_response_without_equations_has_the_motion_of_the_declared_rig(source):
    model, measured = (reduced(RIG, item).undeclared_mass for item in (source, WithoutMotion(source)))
    np.testing.assert_allclose(measured.change, model.change, rtol=1e-3)


def test_without_declared_masses_nothing_is_stated(source):
    run = wind_record(RIG, LOADS, seconds=4.0).run
    bare = RIG.model_copy(update={"bodies": ()})
    assert reduce_run(run, bare, None, WithoutMotion(source)).undeclared_mass is None


def test_the_harmonic_that_changes_most_is_named_beyond_two_sigma():
    change = np.array([[1.0, 0.1], [3.0, 0.1], [9.0, 0.1]])
    added = UndeclaredMass(1.5, ("the hub", "plate"), np.array([[0, 0], [1, 0], [0, 0]]), change)
    sigma = np.array([[0.1, 0.1], [1.0, 0.1], [5.0, 0.1]])
    said = "1.5 kg (1 % of the mass that moves) more or less than in the sweeps would not show in the channels"
    assert added.describe(("Fx", "Mx"), sigma) == f"{said}, and changes Fx at harmonic 2 by 3 N (3 sigma) if at plate"
    assert added.describe(("Fx", "Mx"), 10.0 * sigma) == ""


def test_tones_are_joined_by_their_first_harmonic():
    parts = [UndeclaredMass(1.5, ("the hub",), np.zeros((2, 1), int), np.full((2, 1), x)) for x in (1.0, 2.0)]
    joined = join_harmonics_of_masses(parts)
    assert joined is not None and joined.change[:, 0].tolist() == [1.0, 2.0]
    assert join_harmonics_of_masses([parts[0], None]) is None
