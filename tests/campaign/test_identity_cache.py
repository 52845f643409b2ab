"""Values kept by the identity of a frozen object."""

from dataclasses import dataclass

import numpy as np

from balance_cli.campaign.rig.identity_cache import MAX_KEPT, cached_by_identity
from balance_cli.campaign.rig.rig_scales import stiffness_by_motion
from tests.support.rigs import two_degrees_of_freedom


@dataclass(frozen=True)
class Part:
    value: float


def test_equal_objects_are_computed_apart_and_each_only_once():
    calls = []

    @cached_by_identity
    def twice(part, offset=0.0):
        calls.append(part)
        return 2.0 * part.value + offset

    first, second = Part(1.0), Part(1.0)
    assert [twice(first), twice(second), twice(first), twice(second, 1.0)] == [2.0, 2.0, 2.0, 3.0]
    assert [id(part) for part in calls] == [id(first), id(second), id(second)]


def test_an_object_in_the_place_of_a_forgotten_one_is_another_one():
    """Python gives the address of a freed object to the next one: each of these would be at the same place."""
    doubled = cached_by_identity(lambda part: 2.0 * part.value)
    values = np.arange(4.0 * MAX_KEPT)
    assert [doubled(Part(float(value))) for value in values] == (2.0 * values).tolist()


def test_a_geometry_of_other_cells_has_another_stiffness():
    rig = two_degrees_of_freedom()
    cells = tuple(cell.model_copy(update={"stiffness": 2.0 * cell.stiffness}) for cell in rig.cells)
    before, after = stiffness_by_motion(rig), stiffness_by_motion(rig.model_copy(update={"cells": cells}))
    np.testing.assert_allclose(list(after.values()), 2.0 * np.array(list(before.values())))
