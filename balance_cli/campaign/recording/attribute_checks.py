"""Checks of the root attributes of a run file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, TypeGuard

from balance_cli.campaign.recording.run import LARGEST_MAGNITUDE
from balance_cli.campaign.recording.run_schema import as_list, stated_period
from balance_cli.campaign.rig.components import COMPONENTS, EXCITATIONS, RUN_KINDS
from balance_cli.io.errors import UserError

RPM_PER_HERTZ = 60.0
FEWEST_PERIOD_SAMPLES = 2.0
"""Samples in a period, for its fundamental not to lie beyond half the sample rate."""


def name_faults(attributes: Mapping[str, Any]) -> Iterator[UserError]:
    """Yield the faults of the attributes that every kind of run has."""
    for name in ("run", "rig"):
        yield from _text_fault(attributes, name)
    if attributes.get("kind") not in RUN_KINDS:
        yield _attribute_fault("kind", attributes.get("kind"), f"one of {', '.join(RUN_KINDS)}")


def kind_faults(attributes: Mapping[str, Any]) -> Iterator[UserError]:
    """Yield the faults of the attributes that belong to the kind of the run."""
    if attributes["kind"] == "static":
        yield from _text_fault(attributes, "trim")
        return
    rate, speed = attributes.get("sample_rate"), attributes.get("rotor_speed")
    if not is_positive(rate):
        yield _attribute_fault("sample_rate", rate, f"a number above 0 [Hz], at most {LARGEST_MAGNITUDE:g}")
    if not _is_rotor_speed(speed, rate):
        hint = "; 1/min divided by 60" if _is_number(speed) and _is_rotor_speed(speed / RPM_PER_HERTZ, rate) else ""
        yield _attribute_fault("rotor_speed", speed, f"a number from 0 to half the sample rate [Hz]{hint}")
    if attributes["kind"] == "sweep":
        yield from _sweep_faults(attributes)


def is_positive(value: object) -> TypeGuard[float]:
    """Whether an attribute is a positive number of a plausible magnitude."""
    return _is_number(value) and 1.0 / LARGEST_MAGNITUDE <= value <= LARGEST_MAGNITUDE


def _is_rotor_speed(speed: object, rate: object) -> bool:
    """Whether the speed is zero, or a speed at which a revolution holds more than two samples."""
    if _is_number(speed) and speed == 0:
        return True
    return is_positive(speed) and (not is_positive(rate) or speed < rate / 2.0)


def _sweep_faults(attributes: Mapping[str, Any]) -> Iterator[UserError]:
    excited, level = (as_list(attributes.get(name)) for name in ("excited", "level"))
    if not excited or any(name not in COMPONENTS or excited.count(name) > 1 for name in excited):
        yield _attribute_fault("excited", attributes.get("excited"), f"of {', '.join(COMPONENTS)}, each once at most")
    excitation, period = attributes.get("excitation"), stated_period(attributes)
    if excitation not in EXCITATIONS:
        yield _attribute_fault("excitation", excitation, f"one of {', '.join(EXCITATIONS)}")
    if len(level) != len(excited) or not all(is_positive(value) for value in level):
        yield _attribute_fault("level", attributes.get("level"), "an rms above 0 for each component excited")
    if (period is not None or excitation == "multisine") and not _is_period(period, attributes.get("sample_rate")):
        remedy = f"a time of at least {FEWEST_PERIOD_SAMPLES:g} samples [s]"
        yield _attribute_fault("period", attributes.get("period"), remedy)


def _is_period(period: object, rate: object) -> bool:
    """Whether the period holds enough samples at this sample rate."""
    return is_positive(period) and (not is_positive(rate) or period * rate >= FEWEST_PERIOD_SAMPLES)


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _text_fault(attributes: Mapping[str, Any], name: str) -> Iterator[UserError]:
    value = attributes.get(name)
    if not (isinstance(value, str) and value.strip()):
        yield _attribute_fault(name, value, "a name")


def _attribute_fault(name: str, value: object, expected: str) -> UserError:
    fault = "is missing" if value is None else f"is {value!r}"
    return UserError(f"attribute `{name}` {fault}", place=f"attribute {name}", remedy=f"It should be {expected}")
