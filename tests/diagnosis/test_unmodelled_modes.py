"""Resonances without a cause: where each is declared."""

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.search.unmodelled_modes import best_places
from balance_cli.model.balance import balance_model
from tests.support.rigs import rotor_balance


def mode(place, **shape):
    values = {
        "frequency": 50.0,
        "damping_ratio": 0.03,
        "mass": 1.0,
        **{f"shape_{name}": v for name, v in shape.items()},
    }
    return DeclaredEffect(name="extra-mode", where=(place,), parameters=values)


def test_two_resonances_do_not_move_to_one_place():
    """Both move mostly along y: the first is declared there, and the second stays where it is."""
    declared = (mode("x", y=3.0, z=0.1), mode("z", x=0.1, y=4.0))
    first, second = best_places(declared, {})
    assert (first.where, second) == (("y",), declared[1])
    assert best_places(declared[1:], {})[0].where == ("y",)


@pytest.mark.parametrize("share", [1.0, 0.0, 0.4])
def test_what_hangs_on_beside_the_declared_mass_acts_along_its_shape_only(share):
    """With the resonance locked, the mass matrix grows by (1 - c) m phi phi' in the motions of the plate."""
    shape = {"x": 0.1, "z": 0.2, "psi": 0.3, "theta": -0.1, "phi": 0.05}
    declared = mode("y", **shape)
    declared = declared.model_copy(update={"parameters": {**declared.parameters, "declared_share": share, "mass": 2.0}})
    rig = rotor_balance()

    def plate_mass(geometry):
        model = balance_model(geometry)
        return model.system(np.array(model.parameters.value), derivatives=False).equations.mass.value[:6, :6]

    grown = plate_mass(rig.model_copy(update={"effects": (declared,)})) - plate_mass(rig)
    phi = np.array([{**shape, "y": 1.0}[name] for name in ("x", "y", "z", "psi", "theta", "phi")])
    assert grown == pytest.approx((1.0 - share) * 2.0 * np.outer(phi, phi), abs=1e-12)
