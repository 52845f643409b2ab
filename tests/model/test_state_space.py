"""The state space of a balance against its frequency response: effects, filters, delays, relaxations, stability."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import Acquisition, AnalogFilter, DeclaredEffect
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.effects import EFFECTS
from balance_cli.model.realization import Realization, modal_form
from balance_cli.model.relaxation import BAND, hysteretic_law, relaxation_chain
from balance_cli.model.state_space import state_space, with_anti_alias
from balance_cli.model.system_response import response, solve
from balance_cli.signals.anti_alias import anti_alias_response
from tests.support.effect_checks import RIG, SPIN, model_with_effect
from tests.support.realization_error import realization_error
from tests.support.rigs import one_degree_of_freedom, rotor_balance, two_degrees_of_freedom

FREQUENCY = np.concatenate([[0.0], np.geomspace(0.1, 400.0, 200)])
RELATIVE = np.geomspace(*BAND, 400)
ALL = ("x", "y", "z", "psi", "theta", "phi")
LOSS = "structural-damping"
# With these the response is that of finite poles and direct terms; a loss factor makes one that is not.
RATIONAL = [effect for effect in EFFECTS if not effect.needs_mean and effect.name != LOSS]
PLACED = [(effect, where) for effect in RATIONAL for where in dict.fromkeys(effect.places(RIG)[i] for i in (0, -1))]
IDS = [f"{effect.name}@{','.join(where)}" for effect, where in PLACED]

SUPPORT = (
    "support-flexibility",
    ALL,
    {
        "mass": 300.0,
        "inertia_psi": 30.0,
        "inertia_theta": 25.0,
        "inertia_phi": 20.0,
        "damping_ratio": 0.03,
        "z": -0.3,
        "compliance_x": 2e-9,
        "compliance_y": 3e-9,
        "compliance_z": 1e-9,
        "compliance_psi": 1e-8,
        "compliance_theta": 2e-8,
        "compliance_phi": 1e-8,
    },
)
PARALLEL = (
    "parallel-stiffness",
    (),
    {"x": 0.3, "y": -0.2, "z": 0.2, "stiffness_x": 2e3, "stiffness_y": 1e3, "stiffness_z": 4e3, "damping_time": 1e-3},
)
MAST = ("mast-bending", ("x", "y"), {"mass": 10.0, "compliance_x": 4e-9, "compliance_y": 6e-9, "damping_ratio": 0.02})
CARRIED = ("extra-mode", ("x",), {"frequency": 60.0, "damping_ratio": 0.02, "mass": 3.0, "shape_theta": 0.3})
READ = ("extra-mode", ("Fz",), {"frequency": 95.0, "damping_ratio": 0.03, "shape_z1": 0.1, "shape_x": -0.05})
LATE = ("time-delay", ("z1.piezo",), {"delay": 1e-3})
EARLY = ("time-delay", ("x.strain",), {"delay": -2e-3})
CROSSTALK = ("crosstalk", ("x.strain", "z1.strain"), {"fraction": 0.05})
GYROSCOPIC = ("gyroscopic-coupling", (), {"polar_inertia": 3.0})
SLOW = ("high-pass", ("y1.strain",), {"cutoff": 0.03})
TWICE = ("low-pass", ("x.strain",), {"cutoff": 90.0})
SEVERAL = {
    "support, parallel, delay": (SUPPORT, PARALLEL, LATE),
    "mast, gyroscopic": (MAST, GYROSCOPIC),
    "all at once": (SUPPORT, PARALLEL, MAST, CARRIED, READ, LATE, EARLY, CROSSTALK, GYROSCOPIC, SLOW, TWICE),
    "late and early under crosstalk": (LATE, EARLY, CROSSTALK),
    "both kinds of extra mode": (CARRIED, READ),
    "two equal low-passes": (TWICE,),
}
"""Declared together; two low-passes of one channel have equal poles."""


def system_of(*effects, rig=None):
    """The rotor balance, or another rig, with effects (name, place, parameters)."""
    rig = rotor_balance() if rig is None else rig
    declared = tuple(DeclaredEffect(name=name, where=where, parameters=values) for name, where, values in effects)
    return balance_model(rig.model_copy(update={"effects": declared})).system()


def expected(system, spin=0.0, frequency=FREQUENCY):
    return response(system, solve(system, frequency, spin))


def error(found, exact):
    """The largest error over frequency relative to the largest of each channel's response to each load.

    A response is taken as no less than a millionth of what its channel and its load have elsewhere: that is rounding.
    """
    size = np.abs(exact).max(axis=0)
    floor = 1e-6 * np.sqrt(size.max(axis=0) * size.max(axis=1)[:, None])
    scale = np.maximum(size, floor)
    difference = np.abs(found - exact).max(axis=0)
    assert not difference[scale == 0].any()
    return (difference[scale > 0] / scale[scale > 0]).max()


def poles(space):
    return np.linalg.eigvals(space.A)


def assert_same(space, system, spin=0.0, limit=1e-9):
    """Responses agree from 0.1 to 400 Hz and at rest, and all transients decay."""
    assert error(space.response(FREQUENCY), expected(system, spin)) < limit
    assert poles(space).real.max() < 0.0


# ---- responses -------------------------------------------------------------------------------------------------------


def test_rigid_balance():
    system = system_of()
    space = state_space(system)
    assert_same(space, system)
    assert realization_error(space, system, FREQUENCY[1:]) < 1e-12


def test_order_of_the_rigid_balance():
    """Two states for each of six modes and the shaft, one for each of seven low-passes and seven high-passes."""
    space = state_space(system_of())
    assert space.A.shape == (28, 28) and space.B.shape == (28, 6) and space.C.shape == (15, 28)
    # Low-passes of strain gauges and the shaft itself let nothing through at once; nor do modes to piezos.
    assert not space.D.any()


@pytest.mark.parametrize(
    ("effects", "order"), [((SUPPORT, PARALLEL, LATE), 40), ((CARRIED,), 30), ((READ,), 30), ((TWICE,), 29)]
)
def test_order_with_effects(effects, order):
    """Two states more for each further mode, none for a delay."""
    assert len(state_space(system_of(*effects)).A) == order


def test_what_nothing_drives_or_reads_is_left_out():
    """A support without compliance, an extra mode without a share in any spring, motions of no channel."""
    unread = ("extra-mode", ("Fx",), {"frequency": 60.0, "damping_ratio": 0.02})
    rigid = ("support-flexibility", ALL, {f"compliance_{motion}": 0.0 for motion in ALL})
    assert len(state_space(system_of(rigid, unread)).A) == 28
    rig = rotor_balance()
    torque = rig.model_copy(update={"channels": rig.channels[-1:]})
    assert len(state_space(system_of(rig=torque)).A) == 2


def test_what_is_driven_by_rounding_alone_is_left_out():
    """In coordinates that mix the modes the one without a load is driven, and another read, by 1e-16."""
    Q = np.linalg.qr(np.random.default_rng(0).normal(size=(4, 4)))[0]
    A = Q @ np.diag([-1.0, -2.0, -3.0, -4.0]) @ Q.T
    found = modal_form(Realization(A, Q[:, :3].sum(axis=1)[:, None], Q[:, 1:].sum(axis=1)[None], np.zeros((1, 1))))
    np.testing.assert_allclose(np.diag(found.A), [-2.0, -3.0], rtol=1e-12)
    np.testing.assert_allclose(found.transfer_function([1.0])[0, 0], 1 / 3 + 1 / 4, rtol=1e-12)


@pytest.mark.parametrize(("effect", "where"), PLACED, ids=IDS)
@pytest.mark.parametrize("at_null", [False, True], ids=["changed", "at the null"])
def test_every_effect_of_the_response(effect, where, at_null):
    system = model_with_effect(effect, where, at_null).system()
    assert_same(state_space(system, SPIN), system, SPIN)


@pytest.mark.parametrize("effects", SEVERAL.values(), ids=SEVERAL)
@pytest.mark.parametrize("spin", [0.0, SPIN])
def test_several_effects_at_once(effects, spin):
    system = system_of(*effects)
    assert_same(state_space(system, spin), system, spin)


@pytest.mark.parametrize("effects", SEVERAL.values(), ids=SEVERAL)
def test_each_of_them_is_in_the_state_space(effects):
    """The rigid balance's response is far from theirs: agreement is not that of the rigid part alone."""
    assert error(state_space(system_of()).response(FREQUENCY), expected(system_of(*effects), SPIN)) > 1e-3


def test_the_spin_is_in_the_state_space():
    system = system_of(GYROSCOPIC)
    assert error(state_space(system, 0.0).response(FREQUENCY), expected(system, SPIN)) > 1e-3


@pytest.mark.parametrize("compliance", 10.0 ** np.arange(-20.0, -6.0, 0.25))
def test_support_of_any_stiffness(compliance):
    """From a soft one to one whose poles are beyond all others and out of the state space."""
    name, where, values = SUPPORT
    stiff = {key: compliance if key.startswith("compliance") else value for key, value in values.items()}
    system = system_of((name, where, stiff))
    # Its own poles are thousands of times faster than the others then, and rounding of theirs is that of all.
    assert_same(state_space(system), system, limit=1e-9 if compliance > 1e-13 else 1e-8)


@pytest.mark.parametrize("damping_ratio", [0.0, 0.03])
@pytest.mark.parametrize("mass", [0.0, 1e-9, 1e-3])
def test_support_without_mass(mass, damping_ratio):
    values = {"mass": mass, "damping_ratio": damping_ratio, "compliance_x": 1e-8, "compliance_y": 2e-8}
    system = system_of(("support-flexibility", ("x", "y"), values))
    assert_same(state_space(system), system)


@pytest.mark.parametrize("mode", [CARRIED, READ], ids=["carried", "at a load"])
@pytest.mark.parametrize("damping_ratio", [0.999999, 0.9999999999, 1.0])
def test_an_extra_mode_that_is_critically_damped(mode, damping_ratio):
    system = system_of((*mode[:2], {**mode[2], "damping_ratio": damping_ratio}))
    assert_same(state_space(system), system)


@pytest.mark.parametrize("damping_ratio", [1e-6, 0.9999999999, 1.0])
def test_one_degree_of_freedom(damping_ratio):
    system = system_of(rig=one_degree_of_freedom(damping_ratio=damping_ratio))
    space = state_space(system)
    assert_same(space, system)
    assert space.A.shape == (2, 2)


def test_two_equal_modes():
    """Heave and pitch of one frequency: one pair of poles, twice."""
    body = {"name": "bar", "mass": 20.0, "position": [0, 0, 0], "inertia": {"xx": 1.0, "yy": 20 * 0.09, "zz": 1.9}}
    rig = two_degrees_of_freedom()
    content = [rig.bodies[0].model_validate(body)]
    system = system_of(rig=rig.model_copy(update={"bodies": tuple(content)}))
    space = state_space(system)
    assert np.ptp(np.abs(poles(space))) < 1e-9 * np.abs(poles(space)).max()
    assert_same(space, system)


def test_what_is_not_proper_is_refused():
    """A coordinate that is the acceleration of another has no state space."""
    system = system_of(READ)
    mass, last = system.pencil.mass, system.equations.coordinates.index("extra Fz")
    value = mass.value.copy()
    value[last, last] = 0.0
    damping = replace(system.pencil.damping, value=system.pencil.damping.value * (np.arange(len(value)) != last))
    pencil = replace(system.pencil, mass=replace(mass, value=value), damping=damping)
    with pytest.raises(UserError, match="no state space"):
        state_space(replace(system, pencil=pencil))


# ---- form ------------------------------------------------------------------------------------------------------------


def test_modes_stand_in_blocks_of_equal_input_and_output():
    space = state_space(system_of(rig=two_degrees_of_freedom()))
    off = space.A.copy()
    for i in (0, 2):
        block = space.A[i : i + 2, i : i + 2]
        np.testing.assert_array_equal(block, [[block[0, 0], block[0, 1]], [-block[0, 1], block[0, 0]]])
        off[i : i + 2, i : i + 2] = 0.0
    assert not off.any()


def test_delay_is_kept_apart():
    space = state_space(system_of(LATE, EARLY))
    delays = dict(zip(space.channel_names, space.delay, strict=True))
    assert {name: delay for name, delay in delays.items() if delay} == {"z1.piezo": 1e-3, "x.strain": -2e-3}
    np.testing.assert_array_equal(space.A, state_space(system_of()).A)


def test_crosstalk_is_kept_apart():
    space = state_space(system_of(CROSSTALK))
    np.testing.assert_array_equal(space.mixing, system_of(CROSSTALK).equations.mixing.value)
    assert np.count_nonzero(space.mixing - np.eye(15)) == 1
    np.testing.assert_array_equal(space.C, state_space(system_of()).C)


# ---- anti-alias filter -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [1, 2, 3, 4, 6, 8])
def test_anti_alias_filter(order):
    acquisition = Acquisition(filter=AnalogFilter(type="butterworth", order=order, cutoff=170.0))
    system = system_of(LATE, CROSSTALK, READ)
    space = with_anti_alias(state_space(system), acquisition)
    filtered = anti_alias_response(acquisition, FREQUENCY)[:, None, None] * expected(system)
    assert error(space.response(FREQUENCY), filtered) < 1e-9
    assert len(space.A) == len(state_space(system).A) + 6 * order
    assert poles(space).real.max() < 0.0


def test_no_anti_alias_filter():
    space = state_space(system_of())
    assert with_anti_alias(space, Acquisition()) is space


# ---- springs with loss -----------------------------------------------------------------------------------------------


def in_band(system):
    """The frequencies [Hz] at which the chain follows the law."""
    return RELATIVE * system.pencil.reference_frequency


def lossy(where, causality=1.0, loss_factor=0.005):
    return (LOSS, (where,), {"loss_factor": loss_factor, "causality": causality})


def test_the_chain_follows_the_law():
    chain = relaxation_chain()
    assert np.all(chain.strengths > 0) and np.all(chain.rates > 0)
    assert np.abs(chain.transfer_function(1j * RELATIVE) - hysteretic_law(RELATIVE)).max() < 1e-3
    assert abs(chain.transfer_function(1j).real) < 1e-12
    assert chain.transfer_function(0.0) == pytest.approx(-chain.relaxed_decrement)
    assert chain.transfer_function(1e12).real == pytest.approx(chain.instantaneous_increment)


def relaxing(system, frequency):
    """The response with h(s) of the chain itself in place of the law, by the dynamic stiffness."""
    s = 2j * np.pi * frequency[:, None, None]
    pencil = system.pencil
    relative = s[:, 0, 0] / (2 * np.pi * pencil.reference_frequency)
    h = relaxation_chain().transfer_function(relative)[:, None, None]
    stiffness = pencil.stiffness.value + h * pencil.hysteresis.value
    A = stiffness + s * pencil.damping.value + s**2 * pencil.mass.value
    forces = (system.readings.value + h * system.readings_loss.value) @ np.linalg.solve(A, system.inputs.value + 0 * s)
    gains = solve(system, frequency).gains
    springs = [path.spring for path in system.equations.paths]
    return system.equations.mixing.value @ (gains[:, :, None] * forces[:, springs])


LOSSY = {
    "one cell": (lossy("z1"),),
    "all cells": (lossy("all"),),
    "two cells unlike": (lossy("z1"), lossy("x", loss_factor=0.02)),
    "on a support": (lossy("all"), SUPPORT, LATE, CROSSTALK),
}


@pytest.mark.parametrize("effects", LOSSY.values(), ids=LOSSY)
def test_relaxations_are_realised_exactly(effects):
    system = system_of(*effects)
    space = state_space(system)
    assert error(space.response(FREQUENCY), relaxing(system, FREQUENCY)) < 1e-9
    assert poles(space).real.max() < 0.0


@pytest.mark.parametrize("effects", LOSSY.values(), ids=LOSSY)
def test_the_law_of_structural_damping_is_followed(effects):
    """To the error of the chain, times the loss factor and what a resonance of one per cent damping makes of it."""
    system = system_of(*effects)
    assert 1e-9 < realization_error(state_space(system), system, in_band(system)) < 2e-4


def test_without_its_stiffening_no_law_can_be_followed():
    system = system_of(lossy("all", causality=0.0))
    assert realization_error(state_space(system), system, in_band(system)) > 1e-2


def test_relaxations_have_a_state_for_each_independent_elongation():
    """Seven cells on a plate of six motions: six times the chain; one cell alone: once."""
    chain = len(relaxation_chain().rates)
    assert len(state_space(system_of(lossy("all"))).A) == 28 + 6 * chain
    assert len(state_space(system_of(lossy("z1"))).A) == 28 + chain


def test_error_of_a_realisation_weighs_channels_and_loads_alike():
    """A tenth off in the channel of the torque alone: a tenth of one in fifteen, whatever its sensitivity."""
    system = system_of()
    space = state_space(system)
    wrong = replace(space, C=space.C * np.where(np.arange(15) == 14, 1.1, 1.0)[:, None])
    assert realization_error(wrong, system, in_band(system)) == pytest.approx(0.1 / np.sqrt(15), rel=1e-9)
