"""`support-flexibility`: the non-metric side, on which the cells stand, is a rigid body on springs.

Its motions b (those of its center c that are flexible) are further coordinates. A cell at p is elongated by the motion
of the plate relative to the non-metric side,

    d = a' (motion of the plate at p - [I, R(p - c)] b)

and acts on both. Each motion has inertia m, compliance s and damping d = 2 zeta sqrt(m / s); its equation is multiplied
by s, so that it reads b = 0 where s = 0:

    s (m b'' + d b' - sum of the cells' forces on the non-metric side) + b = 0

The plate's own damping D acts on its motion relative to the non-metric side, q - [I R(g - c); 0 I] b: the second term
is the motion of the plate's center of gravity g when both bodies move as one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.components import FREEDOMS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.identity_cache import cached_by_identity
from balance_cli.campaign.rig.rig_scales import inertia_by_motion, stiffness_by_motion
from balance_cli.campaign.rig.torque_meter import FREEDOM_ABOUT
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.geometry_scales import position_bound, rig_length
from balance_cli.model.effects.places import Where, nonempty_subsets
from balance_cli.model.effects.search_hints import BodyMode, SearchHints, Start
from balance_cli.model.mechanics.dual_numbers import Dual, block_diagonal, clip_below, concatenate, constant, stack
from balance_cli.model.mechanics.equations import SHAFT, Equations, dual_motion_at

TRANSLATIONS = FREEDOMS[:3]

SMALL_ARM = 0.065
"""A change of the center that matters, relative to the size of the rig."""
SMALL = 1e-2
"""A compliance that matters, and from which a fit may begin, relative to that of all cells together."""
FLOOR = 1e-6
"""Lower bound of masses and compliances in square roots, relative to their scale: zero has no derivative there."""
START_COMPLIANCE_SHARE = 0.1
"""Compliances from which a search begins, relative to those of the cells: a support is stiffer than the cells."""
RESTART_COMPLIANCE_SHARES = (0.5, 5.0)
"""The same where a fit is stuck: a motion that began too stiff may have ended rigid. A heavy support whose mode is near
those of the balance is softer than the cells, and a fit from half of their compliance ends stiffer again."""
START_DEPTH = 0.2
"""Depth of the center below the lowest cell where a search begins, relative to the height of the hub above it."""


def _places(geometry: Geometry) -> tuple[Where, ...]:
    """All subsets of the motions that the cells resist."""
    stiffness = stiffness_by_motion(geometry)
    return nonempty_subsets(tuple(name for name in FREEDOMS if stiffness[name] > 0))


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    stiffness = stiffness_by_motion(geometry)
    compliances = (
        EffectParameter(
            f"compliance_{name}",
            "m/N" if name in TRANSLATIONS else "rad/(N m)",
            0.0,
            SMALL / stiffness[name],
            f"Motion {name} of the non-metric side per unit load on it.",
            lower=0.0,
            start=SMALL / stiffness[name],
        )
        for name in where
    )
    damping = EffectParameter(
        "damping_ratio",
        "1",
        0.0,
        0.01,
        "Damping ratio of each motion of the non-metric side alone, with the plate removed.",
        lower=0.0,
        upper=1.0,
        start=0.02,
        nuisance=True,
    )
    return (*_inertia_parameters(geometry, where), *compliances, damping, *_center_parameters(geometry, where))


def _center_parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    """Position of the center, as far as the rotations of the non-metric side make it identifiable."""
    identifiable = {"psi": "xy", "theta": "xz", "phi": "yz"}
    axes = sorted({axis for name in where for axis in identifiable.get(name, "")})
    far, arm = position_bound(geometry), SMALL_ARM * rig_length(geometry)
    return tuple(
        EffectParameter(axis, "m", 0.0, arm, f"Position {axis} of its center.", -far, far, nuisance=True)
        for axis in axes
    )


def _inertia_name(motion: str) -> str:
    return "mass" if motion in TRANSLATIONS else f"inertia_{motion}"


def _inertia_parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    """One mass for all translations, one inertia per rotation; they start at those of the metric side."""
    moving = {_inertia_name(name): inertia for name, inertia in inertia_by_motion(geometry).items()}
    sentences = {"mass": "Mass of the non-metric side."}
    return tuple(
        EffectParameter(
            name,
            "kg" if name == "mass" else "kg m2",
            0.0,
            0.1 * moving[name],
            sentences.get(name, f"Inertia of the non-metric side in {name[8:]}, about its center."),
            lower=0.0,
            start=moving[name],
            nuisance=True,
        )
        for name in dict.fromkeys(_inertia_name(motion) for motion in where)
    )


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    p, m, n = equations.parameters, len(where), len(equations.coordinates)
    inertia = stack([values[_inertia_name(name)] for name in where])
    compliance = stack([values[f"compliance_{name}"] for name in where])
    damping = 2.0 * values["damping_ratio"] * _bounded_stiffness_ratios(inertia, compliance, geometry, where).sqrt()
    nothing = constant(np.zeros((m, m)), p)
    wide = equations.with_coordinates(
        names=tuple(f"lower {name}" for name in where),
        mass=inertia.insert_axis(-1) * np.eye(m),
        damping=nothing,
        inputs=constant(np.zeros((m, 6)), p),
        compliance=compliance,
    )
    lower = _motion_at_origin(values, where, p)
    wide = replace(wide, non_metric_motion=concatenate([equations.non_metric_motion, lower], axis=1))
    directions = np.array([cell.direction for cell in geometry.cells])
    motion = wide.relative_motion(np.array([cell.position for cell in geometry.cells]))
    cells = (directions[:, None, :] @ motion)[:, 0]
    torque = wide.elongation[len(directions) :]
    relative = concatenate([constant(np.eye(n), p), -_motion_with_non_metric_side(equations, geometry, lower)], axis=1)
    support = block_diagonal(constant(np.zeros((n, n)), p), damping.insert_axis(-1) * np.eye(m))
    return replace(
        wide,
        elongation=concatenate([cells, torque]),
        damping=relative.T @ equations.damping @ relative + support,
    )


def _motion_at_origin(values: Mapping[str, Dual], where: Where, p: int) -> Dual:
    """Motion (6, m) of the non-metric side at the rig's origin per motion of its center."""
    center = stack([values[axis] if axis in values else constant(0.0, p) for axis in "xyz"])
    at_origin = concatenate([dual_motion_at(-center), constant(np.eye(6)[3:], p)])
    return at_origin[:, [FREEDOMS.index(name) for name in where]]


def _motion_with_non_metric_side(equations: Equations, geometry: Geometry, lower: Dual) -> Dual:
    """Motion (n, m) of each coordinate when the plate moves with the non-metric side, and shafts that it carries."""
    along = concatenate([dual_motion_at(equations.center), constant(np.eye(6)[3:], equations.parameters)]) @ lower
    turned = {
        meter.label(SHAFT): FREEDOM_ABOUT[meter.axis] for meter in geometry.shaft_meters if meter.carried_by == "plate"
    }
    still = constant(np.zeros(lower.value.shape[1]), equations.parameters)
    motions = {name: along[FREEDOMS.index(motion)] for name, motion in turned.items()}
    others = equations.coordinates[len(equations.freedom) :]
    return stack([*(along[i] for i in equations.freedom), *(motions.get(name, still) for name in others)])


def _search_places(geometry: Geometry) -> tuple[Where, ...]:
    """All motions at once; those that prove rigid are removed after the fit."""
    return _places(geometry)[-1:]


def _starts(geometry: Geometry, where: Where) -> tuple[Mapping[str, float], ...]:
    """A support as heavy as the metric side and stiffer than the cells; center below the cells, at them, far below."""
    stiffness = stiffness_by_motion(geometry)
    lowest = min(cell.position[2] for cell in geometry.cells)
    depth = START_DEPTH * max(abs(geometry.hub[2] - lowest), 1e-3 * rig_length(geometry))
    compliances = {f"compliance_{name}": START_COMPLIANCE_SHARE / stiffness[name] for name in where}
    return tuple({"z": lowest - times * depth, **compliances} for times in (1.0, 0.0, 2.0))


def _restarts(geometry: Geometry, where: Where) -> tuple[Start, ...]:
    """One motion after another nearly as soft as the cells, or softer, with the inertia of the metric side."""
    stiffness, inertia = stiffness_by_motion(geometry), inertia_by_motion(geometry)
    return tuple(
        {
            f"compliance_{name}": share / stiffness[name],
            **({} if name in TRANSLATIONS else {_inertia_name(name): inertia[name]}),
        }
        for name in where
        for share in RESTART_COMPLIANCE_SHARES
    )


def _body_start(start: Start, modes: Mapping[str, BodyMode]) -> Start:
    """The modes of the motions; the translations, which have one mass, with that of the one that shows it best."""
    values = dict(start)
    shown = {name: mode for name, mode in modes.items() if name in TRANSLATIONS}
    mass = max(shown.values(), key=lambda mode: mode.explained).inertia if shown else None
    for name, mode in modes.items():
        inertia = mass if name in TRANSLATIONS and mass is not None else mode.inertia
        values[_inertia_name(name)] = inertia
        values[f"compliance_{name}"] = 1.0 / (inertia * (2 * np.pi * mode.frequency) ** 2)
    return values


def _bounded_stiffness_ratios(inertia: Dual, compliance: Dual, geometry: Geometry, where: Where) -> Dual:
    """Inertia over compliance (m,), both bounded away from zero, where a square root has no derivative."""
    scale = _parameter_scales(geometry, where)
    ratios = [
        clip_below(inertia[i], FLOOR * scale[_inertia_name(name)])
        * clip_below(compliance[i], FLOOR * scale[f"compliance_{name}"]).reciprocal()
        for i, name in enumerate(where)
    ]
    return stack(ratios)


@cached_by_identity
def _parameter_scales(geometry: Geometry, where: Where) -> dict[str, float]:
    """The scale of each parameter, by name."""
    return {item.name: item.scale for item in _parameters(geometry, where)}


EFFECT = Effect(
    name="support-flexibility",
    summary="The non-metric side yields under the cells, with mass, stiffness and damping of its own.",
    validity="Small motions of a rigid body whose springs and inertias act at one point, its center, along the rig's "
    "axes and without coupling between them.",
    reference="The 1985 paper, section 3, assumes it away (`the eigenfrequencies of the support do not influence the "
    "balance dynamics`). Den Hartog, Mechanical Vibrations, 4th ed., 1956, chapter 3 (two degrees of freedom).",
    signature="Eigenfrequencies are lower than computed and further resonances appear above them, while the static "
    "calibration does not change: at rest the cells carry the loads whatever they stand on.",
    separated_by="Accelerometers on the non-metric side, or a sweep with it clamped or loaded with a known mass.",
    place="the motions of the non-metric side that are flexible, any of x y z psi theta phi",
    places=_places,
    parameters=_parameters,
    apply=_apply,
    search=SearchHints(
        places=_search_places, starts=_starts, restarts=_restarts, body_start=_body_start, at_most_once=True
    ),
)
