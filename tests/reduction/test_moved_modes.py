"""Modes that lie elsewhere than in the model make loads doubtful; sound runs are left alone."""

from __future__ import annotations

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.reduction.check_contradiction import flag_by_turbulence
from balance_cli.reduction.flags import MODEL_CONTRADICTED
from balance_cli.reduction.moved_modes import mode_shapes, moved_modes
from balance_cli.reduction.operational_modes import OperationalModes
from balance_cli.reduction.rotor_record import rotor_record
from balance_cli.signals.distributions import chi2
from tests.reduction.test_suspect_channels import computed
from tests.support.measured_source import measured_responses
from tests.support.other_rigs import other_rig
from tests.support.report_content import loads as hub_loads
from tests.support.wind_record import wind_record

PREDICTED = np.array([14.0, 40.0, 67.0])
SIGMA = np.array([0.1, 0.1, 0.2])
RIG = other_rig("D")


@pytest.fixture(scope="module")
def model():
    return computed(RIG)[1]


@pytest.fixture(scope="module")
def measured(model):
    return measured_responses(model, RIG)


def modes(*departure: float) -> OperationalModes:
    return OperationalModes(PREDICTED, PREDICTED * (1.0 + np.array(departure)), SIGMA)


def test_a_mode_that_moved_is_named_with_its_sigma() -> None:
    moved = moved_modes(modes(0.001, -0.03, np.nan))
    assert moved is not None
    assert moved.predicted.tolist() == [40.0] and moved.departure == pytest.approx([-0.03])
    assert "that at 40 Hz by -3 +- 0.3 %: the mass, a stiffness or the support has changed" in moved.sentence


def test_modes_that_moved_together_are_found_where_no_single_one_shows_it() -> None:
    share = 4.2 * np.hypot(SIGMA / PREDICTED, 0.002)
    assert moved_modes(modes(*(0.5 * share))) is None
    moved = moved_modes(modes(*share))
    assert moved is not None and len(moved.predicted) == 3
    assert chi2.sf(4.2**2, 1) > 1e-6


@pytest.mark.parametrize("departure", [(0.0, 0.0, 0.0), (0.002, -0.004, 0.003), (np.nan, np.nan, np.nan)])
def test_modes_in_their_places_say_nothing(departure: tuple[float, float, float]) -> None:
    assert moved_modes(modes(*departure)) is None


def test_the_error_of_a_load_is_that_of_an_oscillator_with_another_mass() -> None:
    """A cell reads k x for f = (k - m w^2 + j w d) x: with the mass of the model the load is off by dm w^2 x."""
    mass, stiffness, frequency = 2.0, 2.0 * (2 * np.pi * 40.0) ** 2, np.array([0.0, 10.0, 30.0, 55.0])
    damping, change = 2.0 * 0.01 * np.sqrt(mass * stiffness), 0.04
    w = 2 * np.pi * frequency
    load = stiffness - mass * w**2 + 1j * w * damping
    expected = np.abs(change * mass * w**2 / load)
    moved = moved_modes(modes(0.0, (1.0 + change) ** -0.5 - 1.0, 0.0))
    assert moved is not None
    assert moved.error_share(frequency) == pytest.approx(expected, rel=0.04)


def test_modes_that_do_not_show_have_moved_as_those_that_do() -> None:
    """One mode tells that a mass is there, and a load near another one was wrong by 14 sigma without a flag."""
    moved = moved_modes(modes(np.nan, -0.03, -0.01))
    assert moved is not None
    near_first = np.array([11.0])
    r = 11.0 / 14.0
    rms = np.sqrt((0.03**2 + 0.01**2) / 2.0)
    assert moved.error_share(near_first) == pytest.approx(2 * rms * r**2 / (1 - r**2), rel=0.01)


def test_the_error_at_a_mode_is_limited_by_its_own_damping() -> None:
    light, heavy = (
        moved_modes(OperationalModes(PREDICTED, PREDICTED * [1.0, 0.97, 1.0], SIGMA, np.full(3, damping)))
        for damping in (0.01, 0.05)
    )
    assert light is not None and heavy is not None
    at_mode = PREDICTED[1:2]
    assert light.error_share(at_mode) == pytest.approx([3.0]) and heavy.error_share(at_mode) == pytest.approx([0.6])


def gusty_record(source, mass):
    """A wind record with turbulence of a tenth of the loads, of a rig with a further mass at the hub."""
    values = dict(zip(("mass", "x", "y", "z"), (mass, *RIG.hub), strict=True))
    rig = RIG.model_copy(update={"effects": (DeclaredEffect(name="added-mass", parameters=values),) if mass else ()})
    size, rng = np.array([40.0, 40.0, 60.0, 8.0, 8.0, 4.0]), np.random.default_rng(3)
    harmonics = size * np.exp(2j * np.pi * rng.uniform(size=(9, 6)))
    gusts = 0.1 * size * rng.standard_normal((40_000, 6))
    further = lambda time, psi: gusts[: len(time)]  # noqa: E731
    run = wind_record(rig, harmonics, seconds=16.0, rate=600.0, noise=1e-4, further=further).run
    return rotor_record(run, RIG, source)


def test_measured_responses_tell_shapes_as_the_model_does(model, measured) -> None:
    record = gusty_record(model, 0.0)
    ours, exact = mode_shapes(record, measured), mode_shapes(record, model)
    assert ours is not None and exact is not None
    for s, volts in zip(ours.s, ours.volts.T, strict=True):
        near = exact.volts[:, np.abs(exact.s - s) < 0.01 * np.abs(s)]
        alike = np.abs(near.conj().T @ volts) / np.linalg.norm(near, axis=0) / np.linalg.norm(volts)
        assert alike.max() > 0.999
    assert np.all(np.diff(np.abs(ours.s)) > 0.0)


@pytest.mark.parametrize(("mass", "flagged"), [(0.0, False), (5.0, True)])
def test_a_mass_is_seen_by_measured_responses_too(mass: float, flagged: bool, model, measured) -> None:
    """3 % at the hub: loads by measured responses were 2 to 60 sigma off, and only those by a model had a flag."""
    record, loads = gusty_record(model, mass), next(iter(hub_loads().runs.values()))
    result = flag_by_turbulence(loads, record, RIG, measured)
    assert any(MODEL_CONTRADICTED in words for row in result.flags for words in row) == flagged
    wider = (result.sigma_cosine[1:] > 1.001 * loads.sigma_cosine[1:]).any()
    assert wider == flagged and np.array_equal(result.sigma_cosine[0], loads.sigma_cosine[0])
