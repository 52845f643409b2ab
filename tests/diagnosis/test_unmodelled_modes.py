"""Resonances without a cause: where each is declared."""

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.search.unmodelled_modes import best_places


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
