"""What the study of attribution hides: effects small or large, alone or together, known or not, or nothing at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from balance_cli.simulation import CampaignPlan, RotorPlan, SweepPlan
from balance_cli.simulation.preset_plans import HIGH_SWEEP_LEVELS, blade_loads, static_plans

EXCITATIONS = ("multisine", "random", "stepped")
SIZES = (25.0, 1e4)
"""Expected gains in chi-square between which the sizes of one effect alone are spread, evenly in their logarithm."""
PAIR_SIZES = (100.0, 1e4)
LARGE_SIZES = (1e5, 1e7)
"""Expected gains of a large effect."""
SINGLE_TURNS = 10
PAIR_TURNS = 1
LARGE_TURNS = 2
TRIPLES = 18

SWEEPS = len(HIGH_SWEEP_LEVELS)
KINDS = ("single", "pair", "nothing", "unknown", "untestable", "large", "three")

PLACES: dict[str, tuple[str, ...]] = {
    "support-flexibility": ("x,y,z,psi,theta,phi",),
    "mast-bending": ("x,y", "x"),
    "added-mass": ("",),
    "parallel-stiffness": ("",),
    "cell-misalignment": ("z1", "y1", "x"),
    "transverse-stiffness": ("all", "z2"),
    "structural-damping": ("all", "y1"),
    "cubic-stiffness": ("x,inside", "z3,beside"),
    "quadratic-stiffness": ("x,inside", "y2,beside"),
    "dry-friction": ("x", "z1"),
    "channel-gain": ("x.strain", "z4.piezo"),
    "low-pass": ("y1.strain", "z2.piezo"),
    "high-pass": ("x.piezo", "z1.strain"),
    "time-delay": ("x.piezo", "z1.strain"),
    "crosstalk": ("x.strain,z1.strain", "y1.piezo,z3.piezo"),
    "mains-pickup": ("y2.strain", "z3.piezo"),
    "exciter-misalignment": ("Fx,Fz", "My,Fx"),
    "channel-offset": ("x.strain", "torque"),
    "load-offset": ("Fz", "Mx"),
}
"""Effects that a campaign at rest with all six sweeps and static runs can show, at some of their places."""

PAIRS: tuple[tuple[str, str], ...] = (
    ("time-delay@x.piezo", "channel-gain@z4.piezo"),
    ("cubic-stiffness@x,inside", "channel-offset@x.strain"),
    ("support-flexibility@x,y,z,psi,theta,phi", "time-delay@z1.strain"),
    ("mast-bending@x,y", "crosstalk@y1.piezo,z3.piezo"),
    ("dry-friction@x", "low-pass@z2.piezo"),
    ("quadratic-stiffness@y2,beside", "load-offset@Fz"),
    ("cell-misalignment@z1", "exciter-misalignment@Fx,Fz"),
    ("parallel-stiffness", "high-pass@x.piezo"),
    ("transverse-stiffness@z2", "structural-damping@y1"),
    ("channel-gain@x.strain", "low-pass@y1.strain"),
    ("crosstalk@x.strain,z1.strain", "mains-pickup@z3.piezo"),
    ("structural-damping@all", "time-delay@x.piezo"),
    ("load-offset@Mx", "channel-offset@torque"),
    ("cell-misalignment@y1", "dry-friction@z1"),
    ("exciter-misalignment@My,Fx", "channel-gain@z4.piezo"),
    ("transverse-stiffness@all", "mast-bending@x"),
    ("support-flexibility@x,y,z,psi,theta,phi", "cell-misalignment@x"),
    ("parallel-stiffness", "quadratic-stiffness@x,inside"),
)

UNKNOWN = ("tuned-mass", "saturating-channel")
"""What is simulated by the study's own code (`studies/unknown.py`): a second body, which only an empirical mode
describes, and a channel that saturates, which was unknown too before the library had the effect."""
UNTESTABLE = ("gyroscopic-coupling", "channel-offset@x.piezo", "load-offset@Fz")
"""Effects that are there and cannot show: at rest, in a channel that hears no constant load, without such a channel."""


@dataclass(frozen=True)
class Case:
    """One campaign: its kind and number, the labels of what is hidden, the excitation, and the gains to be expected."""

    kind: str
    seed: int
    hidden: tuple[str, ...]
    excitation: str
    sizes: tuple[float, ...]

    @property
    def rng(self) -> np.random.Generator:
        """The random numbers of the case."""
        return np.random.default_rng([self.seed, 11, KINDS.index(self.kind)])


def count(kind: str) -> int:
    """How many campaigns of a kind make the study."""
    singles, pairs = len(PLACES) * SINGLE_TURNS, len(PAIRS) * PAIR_TURNS
    large = len(PLACES) * LARGE_TURNS
    return dict(zip(KINDS, (singles, pairs, 300, 12, 9, large, TRIPLES), strict=True))[kind]


def case(kind: str, seed: int) -> Case:
    """The campaign of this number: effects, places and excitations in turn, sizes in strata."""
    of_kind = (_single, _pair, _nothing, _unknown, _untestable, _large, _triple)
    return of_kind[KINDS.index(kind)](seed)


def _single(seed: int) -> Case:
    names = tuple(PLACES)
    name, turn = names[seed % len(names)], seed // len(names)
    excitation = EXCITATIONS[turn % len(EXCITATIONS)]
    # A stratum of the size for each turn: every excitation goes through all sizes.
    share = (turn + Case("single", seed, (), "", ()).rng.random()) / SINGLE_TURNS
    size = float(SIZES[0] * (SIZES[1] / SIZES[0]) ** share)
    return Case("single", seed, (_label(name, turn // len(EXCITATIONS)),), excitation, (size,))


def _pair(seed: int) -> Case:
    turn = seed // len(PAIRS)
    excitation = EXCITATIONS[(seed + turn) % len(EXCITATIONS)]
    drawn = Case("pair", seed, (), "", ()).rng.uniform(*np.log(PAIR_SIZES), 2)
    return Case("pair", seed, PAIRS[seed % len(PAIRS)], excitation, tuple(float(size) for size in np.exp(drawn)))


def _large(seed: int) -> Case:
    """One effect of each kind, large, its places and the excitations in turn."""
    names = tuple(PLACES)
    name, turn = names[seed % len(names)], seed // len(names)
    excitation = EXCITATIONS[(seed + turn) % len(EXCITATIONS)]
    drawn = Case("large", seed, (), "", ()).rng.uniform(*np.log(LARGE_SIZES))
    return Case("large", seed, (_label(name, turn),), excitation, (float(np.exp(drawn)),))


def _triple(seed: int) -> Case:
    """Three effects of different kinds, drawn, from small ones to large ones."""
    rng = Case("three", seed, (), "", ()).rng
    names = rng.choice(tuple(PLACES), 3, replace=False)
    labels = tuple(_label(str(name), int(rng.integers(2))) for name in names)
    drawn = rng.uniform(*np.log((SIZES[1], LARGE_SIZES[1])), 3)
    return Case("three", seed, labels, EXCITATIONS[seed % len(EXCITATIONS)], tuple(float(s) for s in np.exp(drawn)))


def _label(name: str, turn: int) -> str:
    where = PLACES[name][turn % len(PLACES[name])]
    return f"{name}@{where}" if where else name


def _nothing(seed: int) -> Case:
    return Case("nothing", seed, (), EXCITATIONS[seed % len(EXCITATIONS)], ())


def _unknown(seed: int) -> Case:
    hidden = UNKNOWN[seed % len(UNKNOWN)]
    return Case("unknown", seed, (hidden,), EXCITATIONS[seed // len(UNKNOWN) % len(EXCITATIONS)], ())


def _untestable(seed: int) -> Case:
    hidden = UNTESTABLE[seed % len(UNTESTABLE)]
    return Case("untestable", seed, (hidden,), EXCITATIONS[seed // len(UNTESTABLE) % len(EXCITATIONS)], ())


def plan(excitation: str, static: bool = True) -> CampaignPlan:
    """Two static runs, a sweep of each component (12 s of a period of 1.5 s, or 10 s that do not repeat), a check run.

    The check run is held out.
    """
    period, periods = (1.5, 8) if excitation == "multisine" else (2.0, 5)
    sweeps = tuple(
        SweepPlan(
            run=f"sweep-{name}",
            excited=(name,),
            level=(level,),
            excitation=excitation,  # type: ignore[arg-type]
            period=period,
            periods=periods,
        )
        for name, level in HIGH_SWEEP_LEVELS.items()
    )
    check = RotorPlan(run="check-1", rotor_speed=17.5, duration=10.0, harmonics=blade_loads("Fx", "Fz", "My"))
    return CampaignPlan(runs=(*(static_plans() if static else ()), *sweeps, check))
