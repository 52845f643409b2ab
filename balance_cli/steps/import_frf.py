"""Measured frequency responses of other programs as those of `sweep-tf`: readings of the channels per hub load."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.frf_map import FrfMap
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.importers.frf.functions import FrfFile, FrfFunction
from balance_cli.importers.frf.variables import Variables
from balance_cli.io.errors import UserError
from balance_cli.signals.response.choices import IMPORTED
from balance_cli.signals.response.point_forces import PointForce
from balance_cli.signals.response.transfer import Transfer
from balance_cli.signals.run_spectrum import FrequencyResponse
from balance_cli.steps.frf_conventions import load_multiples, require_causal
from balance_cli.steps.frf_lines import CommonLines, Curve, common_lines
from balance_cli.steps.frf_matching import MatchedFunction, match_functions
from balance_cli.steps.frf_uncertainty import coherence_of, line_share, response_noise
from balance_cli.steps.frf_units import Conversion, apply_conversions, convert_reference, convert_response
from balance_cli.steps.sweep_tf import add_point_responses, with_contradictions

Array = NDArray[np.float64]

COHERENCE_SLACK = 1e-3
"""By which a coherence may leave its range: rounding, and programs that divide averages of unlike numbers."""


@dataclass(frozen=True)
class _Notes:
    """Notes, each once and in their order; `shared` {text: names} those that several channels or references have."""

    single: dict[str, None] = field(default_factory=dict)
    shared: dict[str, dict[str, None]] = field(default_factory=dict)

    def add(self, *texts: str) -> None:
        """Add notes; an empty one is none."""
        self.single.update(dict.fromkeys(filter(None, texts)))

    def share(self, text: str, name: str) -> None:
        """Add a name to those that have a note."""
        self.shared.setdefault(text, {})[name] = None

    def texts(self) -> tuple[str, ...]:
        """All notes, those with their names last."""
        named = (f"{', '.join(f'`{name}`' for name in names)}: {text}" for text, names in self.shared.items())
        return (*self.single, *named)


@dataclass(frozen=True)
class _Reference:
    """The responses to one reference: `multiples` (6,) are the hub loads for one unit of it."""

    name: str
    multiples: Array
    lines: CommonLines


def import_responses(mapping: FrfMap, sources: Sequence[FrfFile | Variables], geometry: Geometry) -> Transfer:
    """Return the responses of files by a map, for a geometry that has its channels.

    `import_notes` of the result say what was assumed, and where sigma comes from. Raises UserError where functions are
    missing, are no responses of the channels to a force, contradict each other, or have the phases of another
    convention.
    """
    _require_rig(mapping, geometry)
    matched, said = match_functions(mapping, sources)
    notes = _Notes()
    notes.add(*said)
    references = [_reference(name, matched, mapping, geometry, notes) for name in mapping.references]
    responses = [_frequency_response(item, mapping, notes) for item in references]
    require_causal(responses, mapping.time_convention)
    at_hub, points = _hub_and_points(references, responses)
    combined, faults = add_point_responses(at_hub, points)
    transfer = Transfer(
        geometry=geometry,
        responses=tuple(combined),
        estimator=IMPORTED,
        channels_left_out={item.name: item.lines.left_out for item in references if item.lines.left_out},
        unused_runs=faults,
        import_notes=notes.texts(),
    )
    return with_contradictions(transfer)


def _require_rig(mapping: FrfMap, geometry: Geometry) -> None:
    if mapping.rig != geometry.rig:
        fault = f"belongs to the rig `{mapping.rig}`, the geometry to `{geometry.rig}`"
        raise UserError(fault, place="rig", remedy="Give map and geometry of one rig")
    unknown = [item.name for item in mapping.responses.values() if item.name not in geometry.channel_names]
    if unknown:
        known = ", ".join(geometry.channel_names)
        fault = f"`{unknown[0]}` is no channel of the geometry"
        raise UserError(fault, place="responses", remedy=f"Its channels are {known}")


def _reference(
    name: str, matched: Sequence[MatchedFunction], mapping: FrfMap, geometry: Geometry, notes: _Notes
) -> _Reference:
    """The responses to one reference of the map, in readings per unit of it."""
    own = [item for item in matched if item.reference == name]
    multiples, note = load_multiples(name, mapping.references[name], own[0].function.reference, geometry.hub)
    notes.add(note)
    # In the order of the geometry, as those of sweeps are.
    own.sort(key=lambda item: geometry.channel_names.index(mapping.responses[item.response].name))
    curves = {}
    for item in own:
        try:
            curves[mapping.responses[item.response].name] = _curve(item, mapping, geometry, notes)
        except UserError as error:
            raise error.with_location(file=item.file) from error
    lines = common_lines(curves, name)
    notes.add(*lines.notes)
    return _Reference(name, multiples, lines)


def _curve(item: MatchedFunction, mapping: FrfMap, geometry: Geometry, notes: _Notes) -> Curve:
    """A function in readings of its channel per unit of its reference, with the phase of exp(+j omega t)."""
    function, mapped = item.function, mapping.responses[item.response]
    channel = geometry.channels[geometry.channel_names.index(mapped.name)]
    response = convert_response(function, mapped, channel)
    reference = convert_reference(function, mapping.references[item.reference])
    notes.add(*_assumptions(item, response, reference))
    if response.by_sensitivity:
        notes.share(f"in {response.by_sensitivity}, converted by the declared sensitivity", mapped.name)
    if mapping.time_convention == "exp(-jwt)":
        notes.add("conjugated, as the map states exp(-jwt)")
        function = _conjugate(function)
    value = apply_conversions(function, response, reference)
    return Curve(function.frequency, value, _coherence(item), function.resolution)


def _assumptions(item: MatchedFunction, response: Conversion, reference: Conversion) -> Iterator[str]:
    """What was assumed of a function, in words."""
    yield from (note for note in (response.note, reference.note) if note)
    terminal = item.function.response
    if terminal.direction.startswith("-"):
        yield f"`{terminal.name}`: the direction of a response is not applied, the channel counts as it was recorded"


def _conjugate(function: FrfFunction) -> FrfFunction:
    return replace(function, value=function.value.conj())


def _coherence(item: MatchedFunction) -> Array | None:
    """The coherence of a function at its lines. Raises UserError where it is none, or of other lines."""
    if item.coherence is None:
        return None
    values = item.coherence.value
    if values.shape != item.function.frequency.shape:
        pair, lines = f"`{item.response}` with `{item.reference}`", len(item.function.frequency)
        fault = f"the coherence of {pair} has {len(values)} lines, the response {lines}"
        raise UserError(fault, place=item.coherence.place, remedy="Export both at the same lines")
    finite = values[np.isfinite(values)]
    if np.any((finite < -COHERENCE_SLACK) | (finite > 1.0 + COHERENCE_SLACK)):
        fault = f"the coherence of `{item.response}` with `{item.reference}` is not between 0 and 1"
        raise UserError(fault, place=item.coherence.place, remedy="Export the ordinary coherence as a ratio")
    return np.clip(np.nan_to_num(values), 0.0, 1.0)


def _frequency_response(item: _Reference, mapping: FrfMap, notes: _Notes) -> FrequencyResponse:
    """The response to one reference with its covariance; errors of channels are taken as independent.

    Where sigma comes from is added to the notes.
    """
    lines = item.lines
    noise = response_noise(lines, mapping)
    notes.share(noise.origin, item.name)
    coherence = coherence_of(lines, noise.variance, mapping.averages)
    size = len(lines.channels)
    largest = COMPONENTS[int(np.argmax(np.abs(item.multiples[:3])))] if item.multiples[:3].any() else ""
    component = largest or COMPONENTS[int(np.argmax(np.abs(item.multiples)))]
    return FrequencyResponse(
        run=item.name,
        channel_names=lines.channels,
        components=(component,),
        estimator=IMPORTED,
        frequency=lines.frequency,
        response=lines.response[:, :, None],
        channel_covariance=(noise.variance[:, :, None] * np.eye(size)).astype(complex),
        load_covariance=np.ones((len(lines.frequency), 1, 1), complex),
        coherence=coherence[:, :, None],
        multiple_coherence=coherence,
        rotor_speed=mapping.rotor_speed,
        level=(float("nan"),),
        noise_dof=noise.dof,
        line_share=line_share(mapping, len(lines.frequency)),
    )


def _hub_and_points(
    references: Sequence[_Reference], responses: Sequence[FrequencyResponse]
) -> tuple[list[FrequencyResponse], list[PointForce]]:
    """The responses to single hub loads, and those to forces that drive several at once."""
    at_hub, points = [], []
    for item, response in zip(references, responses, strict=True):
        driven = np.flatnonzero(item.multiples)
        if len(driven) == 1:
            factor = float(item.multiples[driven[0]])
            at_hub.append(
                replace(
                    response,
                    components=(COMPONENTS[int(driven[0])],),
                    response=response.response / factor,
                    channel_covariance=response.channel_covariance / factor**2,
                )
            )
        else:
            points.append(PointForce(response, item.multiples))
    return at_hub, points
