"""Static loads in another unit than the file says, also of a rig that is only calibrated.

Cells with declared sensitivities have it by equilibrium, rated loads by coincidence: one component may have been loaded
to any share of its rated load, all of them to the same share, that of a unit, hardly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.equilibrium import Equilibrium, equilibrium
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_checks import missing_mechanics
from balance_cli.campaign.rig.load_components import LoadComponents, load_components
from balance_cli.diagnosis.consistency.findings import LOAD_FACTOR, WARNING, ConsistencyFinding
from balance_cli.diagnosis.consistency.units import (
    FORCE_UNITS,
    MOMENT_UNITS,
    UNIT_TOLERANCE,
    VOLT_UNITS,
    suggest_units,
)
from balance_cli.io.units import FORCE, INCH, POUND_FORCE, STANDARD_GRAVITY
from balance_cli.signals.response_rows import response_rows

if TYPE_CHECKING:
    from balance_cli.calibration.result import Calibration

Array = NDArray[np.float64]

LARGEST_REST = 0.1
"""Of the squares of a load by equilibrium: what the applied load times a factor may leave; a correlation of 0.95."""
LARGEST_SPREAD = 0.2
"""Of the logarithms of factors that are one: sensitivities declared by a data sheet are off by a tenth at most."""
SPREAD_SHARE = 1.0 / 3.0
"""The same over the logarithm of the factor: the next components must not be nearer to one than to the factor."""
FEWEST_COMPONENTS = 2
"""Components with one factor: a single one may depend on one cell, whose sensitivity is wrong."""
RATED_TOLERANCE = 0.1
"""Departure from a rated load, as a logarithm, of loads that were applied up to it."""
SINGLE_FORCE_UNITS = {"lbf": POUND_FORCE, "kgf": STANDARD_GRAVITY}
"""Units in which a single component is stated by mistake; of those of a thousand the size alone tells."""
SINGLE_MOMENT_UNITS = {"in lbf": POUND_FORCE * INCH, "kgf m": STANDARD_GRAVITY}
"""The same of moments: in ft lbf one is 1.36 times too small, which a schedule may be, too."""
MOST_OF_RATED = 0.4
"""Logarithm of the share of the rated loads to which all others were loaded, at the most: to about all of it."""
FEWEST_RATED = 3
"""Components that were loaded to one share of their rated loads: two may be by accident."""


def static_unit_findings(geometry: Geometry, runs: Sequence[Run]) -> Iterator[ConsistencyFinding]:
    """Yield a warning for each group of components whose static loads have a factor that is one between units.

    Loads by equilibrium are compared; where the channels tell fewer than two, rated loads. `geometry` may lack bodies
    and stiffness.
    """
    static = [run for run in runs if run.kind == "static"]
    parts = [part for run in static if (part := response_rows(run, geometry.channel_names)) is not None]
    if not parts:
        return
    channels = np.concatenate([part.channels.real for part in parts])
    loads = np.concatenate([part.loads.real for part in parts])
    is_known = np.isfinite(channels).all(axis=0)
    names = [name for name, known in zip(geometry.channel_names, is_known, strict=True) if known]
    balanced = equilibrium(geometry, names)
    if len(balanced.components) >= FEWEST_COMPONENTS:
        read = channels[:, [geometry.channel_names.index(name) for name in balanced.channels]]
        yield from equilibrium_findings(balanced, read, loads, tuple(part.run for part in parts))
    elif geometry.rated_loads and missing_mechanics(geometry):
        yield from _rated_findings(geometry, [run for run in static if run.has_loads])


def matrix_unit_findings(calibration: Calibration) -> Iterator[ConsistencyFinding]:
    """Yield the warnings of a calibration without rows: a matrix made elsewhere says what loads it was made with."""
    trim = next(iter(calibration.trims.values()))
    components = load_components(calibration.geometry)
    if trim.rows or not set(trim.components) <= set(components.names):
        return
    balanced = equilibrium(calibration.geometry, trim.channel_names)
    size = np.where(trim.calibrated_range > 0.0, trim.calibrated_range, 1.0)
    C0 = trim.C0[[trim.channel_names.index(name) for name in balanced.channels]]
    to_hub = components.to_hub[[components.names.index(name) for name in trim.components]]
    yield from equilibrium_findings(balanced, (C0 * size).T, size[:, None] * to_hub)


def equilibrium_findings(
    balanced: Equilibrium, channels: Array, loads: Array, runs: tuple[str, ...] = ()
) -> Iterator[ConsistencyFinding]:
    """Yield the findings from readings (n, c) of the channels of `balanced` and hub loads (n, 6), from their means."""
    with np.errstate(over="ignore", invalid="ignore"):  # of values without meaning, which have no factor
        factors = dict(_factors(balanced, channels, loads))
    common = _common_factor([*factors.values()])
    forces = {name: factor for name, factor in factors.items() if name.startswith("F")}
    moments = {name: factor for name, factor in factors.items() if name not in forces}
    is_one = common is not None and bool(forces)
    groups = [(factors, FORCE_UNITS)] if is_one else [(forces, FORCE_UNITS), (moments, MOMENT_UNITS)]
    for group, units in groups:
        factor = _common_factor([*group.values()])
        hint = suggest_units(1.0 / factor, units) if factor else ""
        if not factor or not hint:
            continue
        names = tuple(group)
        volts = suggest_units(factor, VOLT_UNITS) if is_one else ""
        text = (
            f"the static loads {', '.join(names)}, stated in N and N m, are {1.0 / factor:.4g} times what the channels "
            f"read by their declared `sensitivity`: {hint}" + (f" Or the readings: {volts}" if volts else "")
        )
        yield ConsistencyFinding(LOAD_FACTOR, WARNING, text, runs, True, components=names, factor=1.0 / factor)


def _factors(balanced: Equilibrium, channels: Array, loads: Array) -> Iterator[tuple[str, float]]:
    """Yield name and factor, load by equilibrium over applied load, of the components that have one."""
    by_cells = channels @ balanced.loads_per_reading
    for j, name in enumerate(balanced.components):
        applied, found = loads[:, COMPONENTS.index(name)], by_cells[:, j]
        power, product, size = float(applied @ applied), float(applied @ found), float(found @ found)
        if power > 0.0 and product > 0.0 and size - product / power * product < LARGEST_REST * size:
            yield name, product / power


def _common_factor(factors: Sequence[float]) -> float | None:
    """Return the median of factors that are one; None where they are not, or are too few."""
    if len(factors) < FEWEST_COMPONENTS:
        return None
    logs = np.log(factors)
    middle = float(np.median(logs))
    return float(np.exp(middle)) if np.ptp(logs) < min(LARGEST_SPREAD, SPREAD_SHARE * abs(middle)) else None


def _rated_findings(geometry: Geometry, runs: Sequence[Run]) -> Iterator[ConsistencyFinding]:
    """Yield a warning where all components were loaded to that share of their rated loads that is one of a unit."""
    components = load_components(geometry)
    rated = np.array([(geometry.rated_loads or {}).get(name, np.nan) for name in components.names])
    hub_loads = np.concatenate([np.nan_to_num(loads) for run in runs if (loads := run.read().loads) is not None])
    share = np.max(np.abs(components.from_hub_loads(hub_loads)), axis=0, initial=0.0) / rated
    is_force = np.array(components.units) == FORCE
    if len(share) < FEWEST_RATED or not np.all(share > 0.0):
        return
    yield from _one_in_another_unit(components, share, tuple(run.name for run in runs))
    forces, moments = _units_of_all(share[is_force], FORCE_UNITS), _units_of_all(share[~is_force], MOMENT_UNITS)
    if not (forces or moments) or (is_force.any() and not forces) or (not is_force.all() and not moments):
        return
    units = ", ".join(" or ".join(names) for names in (forces, moments) if names)
    shown = ", ".join(f"{name} {value:.3g}" for name, value in zip(components.names, share, strict=True))
    text = f"the largest static loads over the rated ones are {shown}: are they in {units}, or were they so small?"
    names = tuple(run.name for run in runs)
    yield ConsistencyFinding(LOAD_FACTOR, WARNING, text, names, True, components=components.names)


def _one_in_another_unit(
    components: LoadComponents, share: Array, runs: tuple[str, ...]
) -> Iterator[ConsistencyFinding]:
    """Yield a warning where one share (k,) of a rated load differs by a unit from the others, which are alike."""
    for j, name in enumerate(components.names):
        others = np.log(np.delete(share, j))
        common = float(np.median(others))
        if len(others) < FEWEST_RATED or np.ptp(others) > LARGEST_SPREAD or not abs(common) < MOST_OF_RATED:
            continue
        units = SINGLE_FORCE_UNITS if components.units[j] == FORCE else SINGLE_MOMENT_UNITS
        ratio = common - float(np.log(share[j]))
        written = [unit for unit, value in units.items() if abs(ratio - np.log(value)) < UNIT_TOLERANCE]
        rated = [unit for unit, value in units.items() if abs(ratio + np.log(value)) < UNIT_TOLERANCE]
        if written or rated:
            doubt = f"{'loads' if written else 'a rated load'} in {' or '.join(written or rated)}"
            text = (
                f"{name} was loaded to {share[j]:.3g} of its rated load and the other components to "
                f"{np.exp(common):.3g} of theirs ({doubt}, not in {components.units[j]}?)"
            )
            yield ConsistencyFinding(LOAD_FACTOR, WARNING, text, runs, True, components=(name,), factor=share[j])


def _units_of_all(share: Array, units: dict[str, float]) -> list[str]:
    """Return the units in which loads of these shares (k,) of the rated ones would all have been up to them."""
    return [
        name for name, value in units.items() if len(share) and np.all(np.abs(np.log(share * value)) < RATED_TOLERANCE)
    ]
