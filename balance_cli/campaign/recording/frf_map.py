"""The map of measured frequency responses: which function of a file is which channel over which load."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, ValidationError, model_validator

from balance_cli.campaign.recording.import_map import Component, Sign, TextSettings
from balance_cli.campaign.recording.import_map_file import refuse_unfinished
from balance_cli.campaign.rig.declared_values import (
    FrozenModel,
    Name,
    NonNegative,
    Number,
    Positive,
    Vector,
    name_as_mapping,
)
from balance_cli.io.errors import UserError
from balance_cli.io.formats import FRF_MAP_FORMAT
from balance_cli.io.sniff import describe_file, is_hdf5, require_file
from balance_cli.io.validation import validation_faults
from balance_cli.io.yaml_file import read_yaml

Axis = Literal["line", "response", "reference"]
Window = Literal["none", "hann", "hamming", "blackman", "flattop"]
Unit = Annotated[str, Field(min_length=1, max_length=40)]
Pattern = Annotated[str, Field(min_length=1, max_length=300)]


def _component_as_mapping(value: object) -> object:
    return {"component": value} if isinstance(value, str) else value


class MappedResponse(FrozenModel):
    """A response of the file that is the channel `name`; `scale` is in volts for one base unit of `unit`."""

    name: Name
    unit: Unit | None = None
    sign: Sign = 1
    scale: Number | None = None

    @model_validator(mode="after")
    def _check_scale(self) -> MappedResponse:
        if self.scale == 0.0:
            raise ValueError("`scale` is zero")
        return self


class MappedReference(FrozenModel):
    """A reference of the file: a hub load, or a force at `position` [m] along `direction`, both in rig axes.

    Without `sign` it is that of the direction of the file.
    """

    component: Component | None = None
    position: Vector | None = None
    direction: Vector | None = None
    unit: Unit | None = None
    sign: Sign | None = None

    @model_validator(mode="after")
    def _check_kind(self) -> MappedReference:
        is_point = self.position is not None and self.direction is not None
        if (self.position is None) != (self.direction is None) or is_point == (self.component is not None):
            raise ValueError("give either `component`, or `position` and `direction`")
        if self.direction is not None and not any(self.direction):
            raise ValueError("`direction` has no length")
        return self


class MappedPair(FrozenModel):
    """Arrays (columns, variables) of one response over one reference, in the files that fit `file`."""

    file: Pattern = "*"
    response: Name
    reference: Name
    value: Name | None = None
    real: Name | None = None
    imaginary: Name | None = None
    magnitude: Name | None = None
    phase: Name | None = None
    coherence: Name | None = None

    @model_validator(mode="after")
    def _check_parts(self) -> MappedPair:
        given = [name for name in ("value", "real", "imaginary", "magnitude", "phase") if getattr(self, name)]
        if given not in (["value"], ["real", "imaginary"], ["magnitude", "phase"]):
            raise ValueError("give either `value`, or `real` and `imaginary`, or `magnitude` and `phase`")
        return self


class MappedArray(FrozenModel):
    """An array of responses over references, in the order of the names, in the files that fit `file`."""

    file: Pattern = "*"
    value: Name | None = None
    real: Name | None = None
    imaginary: Name | None = None
    axes: tuple[Axis, ...] | None = None
    responses: Annotated[tuple[Name, ...], Field(min_length=1)]
    references: Annotated[tuple[Name, ...], Field(min_length=1)]
    coherence: Name | None = None

    @model_validator(mode="after")
    def _check_parts(self) -> MappedArray:
        given = [name for name in ("value", "real", "imaginary") if getattr(self, name)]
        if given not in (["value"], ["real", "imaginary"]):
            raise ValueError("give either `value`, or `real` and `imaginary`")
        if self.axes is not None and sorted(self.axes) != ["line", "reference", "response"]:
            raise ValueError("`axes` should be line, response and reference, in the order of the array")
        return self


class FrfMap(FrozenModel):
    """A map of frequency responses, as declared in YAML."""

    format: Literal["balance-frf/1"]
    rig: Name
    text: TextSettings = TextSettings()
    responses: Annotated[dict[str, Annotated[MappedResponse, BeforeValidator(name_as_mapping)]], Field(min_length=1)]
    references: Annotated[
        dict[str, Annotated[MappedReference, BeforeValidator(_component_as_mapping)]], Field(min_length=1)
    ]
    frequency: Name | None = None
    frequency_unit: Unit | None = None
    pairs: tuple[MappedPair, ...] = ()
    arrays: tuple[MappedArray, ...] = ()
    phase_unit: Literal["deg", "rad"] = "deg"
    magnitude_unit: Literal["linear", "dB"] = "linear"
    time_convention: Literal["exp(+jwt)", "exp(-jwt)"] = "exp(+jwt)"
    averages: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    window: Window | None = None
    uncertainty: Positive | None = None
    rotor_speed: NonNegative = 0.0

    @model_validator(mode="after")
    def _check_names(self) -> FrfMap:
        components: list[str] = [item.component for item in self.references.values() if item.component]
        for what, names in (("channel", [item.name for item in self.responses.values()]), ("component", components)):
            repeated = sorted({name for name in names if names.count(name) > 1})
            if repeated:
                raise ValueError(f"two names of the file are the {what} `{repeated[0]}`")
        if (self.pairs or self.arrays) and self.frequency is None:
            raise ValueError("`frequency` is missing: the name of the vector of frequencies")
        for pair in self.pairs:
            for name, known, key in (
                (pair.response, self.responses, "responses"),
                (pair.reference, self.references, "references"),
            ):
                if name not in known:
                    raise ValueError(f"`{name}` of a pair is not among the `{key}` of the map")
        return self


def read_frf_map(path: Path) -> FrfMap:
    """Return the map in a YAML file. Raises UserError for its first fault."""
    try:
        require_file(path)
        if not path.is_file() or is_hdf5(path):
            raise UserError(f"is {describe_file(path)}, where a map was expected", remedy="Give the YAML file of a map")
        declared = read_yaml(path, "a map")
        if not isinstance(declared, dict) or declared.get("format") != FRF_MAP_FORMAT:
            remedy = f"It should begin with `format: {FRF_MAP_FORMAT}`; `balance import-frf --sketch FILE` prints one"
            raise UserError("is not a map of frequency responses", place="format", remedy=remedy)
        refuse_unfinished(declared)
        return FrfMap.model_validate(declared)
    except ValidationError as error:
        raise validation_faults(FrfMap, error)[0].with_location(file=str(path)) from error
    except UserError as error:
        raise error.with_location(file=str(path)) from error
