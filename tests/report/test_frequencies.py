"""Which mode of one model is which of another; how far computed eigenfrequencies are off."""

from dataclasses import replace

import numpy as np

from balance_cli.estimation.identified_model import IdentifiedModel, ModeTable
from balance_cli.report.frequencies import frequency_deviation, match_models, modal_assurance, shaft_mode
from tests.support.report_content import model


def with_modes(base: IdentifiedModel, order, factor=1.0, shapes=True, coordinates=None) -> IdentifiedModel:
    """The same model with its modes in another order, frequencies times `factor` (per mode of the base)."""
    modes = base.modes
    factor = np.broadcast_to(factor, modes.frequency.shape)
    table = ModeTable(
        coordinates=coordinates or modes.coordinates,
        frequency=(modes.frequency * factor)[order],
        damping_ratio=modes.damping_ratio[order],
        sigma_frequency=modes.sigma_frequency[order],
        sigma_damping_ratio=modes.sigma_damping_ratio[order],
        shape=modes.shape[order] if shapes else np.zeros((0, len(coordinates)), complex),
    )
    return replace(base, modes=table)


def test_shapes_find_modes_that_have_changed_places():
    base = model("computed")
    order = np.array([1, 0, 2, 3, 4, 6, 5])
    index = match_models([base, with_modes(base, order)]).index
    assert [partner for _, partner in index] == np.argsort(order).tolist()


def test_the_shaft_is_found_by_its_motion():
    base = model("computed")
    own = np.sqrt(9e4 / 0.65) / (2 * np.pi)
    assert np.isclose(base.modes.frequency[shaft_mode(base.modes)], own, rtol=1e-3)


def test_modes_without_shapes_go_by_their_order_and_leave_the_shaft_out():
    base = model("computed")
    shaft = shaft_mode(base.modes)
    plate = [i for i in range(7) if i != shaft]
    sensors = ("x", "y1", "y2", "z1", "z2", "z34")
    paper = with_modes(base, plate, factor=0.9, shapes=False, coordinates=sensors)
    index = match_models([base, paper]).index
    assert [partner for _, partner in index] == [None if i == shaft else plate.index(i) for i in range(7)]
    assert match_models([paper, base]).index == tuple((b, a) for a, b in index)


def test_a_mode_that_only_one_model_has_gets_a_row_of_its_own():
    base = model("computed")
    fewer = with_modes(base, [0, 1, 2, 4, 5, 6])
    index = match_models([fewer, base]).index
    assert len(index) == 7
    assert index[-1] == (None, 3)


def test_modal_assurance_of_parallel_and_orthogonal_shapes():
    a = np.array([[1.0, 1j, 0.0], [0.0, 0.0, 2.0]])
    np.testing.assert_allclose(modal_assurance(a, np.array([[2j, -2.0, 0.0]])), [[1.0], [0.0]], atol=1e-15)


def test_computed_frequencies_considerably_off_are_counted():
    base = model("computed")
    factor = np.array([1.0, 1.06, 1.0, 0.9, 1.04, 1.0, 1.0])
    found = frequency_deviation(with_modes(base, np.arange(7), factor), base)
    assert found.count == 7
    assert len(found.large_deviations) == 2
    np.testing.assert_allclose(found.largest, 0.1)
