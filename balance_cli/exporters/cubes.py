"""Results as named arrays over named axes, the common form of MAT, NeXus and xarray exports."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.reduction.polar import polar_sigma
from balance_cli.reduction.result import HubLoads, RunLoads
from balance_cli.reduction.spectra_result import LoadSpectra, RunSpectra
from balance_cli.reduction.stored_history import StoredHistory
from balance_cli.signals.response.transfer import Transfer
from balance_cli.signals.run_spectrum import FrequencyResponse

AnyArray = NDArray[Any]


@dataclass(frozen=True)
class Variable:
    """Values over the named axes, with a unit; `sigma` names the variable with its standard deviation."""

    axes: tuple[str, ...]
    values: AnyArray
    unit: str = ""
    sigma: str = ""


@dataclass(frozen=True)
class Cube:
    """Variables over common axes {name: coordinates}.

    `signal` is the variable that a viewer shows first, over the axis `abscissa`; `curves` is the axis of which each
    value is a curve of its own. `about` are facts in words or numbers.
    """

    name: str
    coordinates: Mapping[str, Variable]
    variables: Mapping[str, Variable]
    signal: str
    abscissa: str
    curves: str
    about: Mapping[str, str | float] = field(default_factory=dict)


def cubes_of(content: object) -> tuple[Cube, ...]:
    """Return loads, spectra, a history or responses as arrays, one cube for each run; none for any other result."""
    if isinstance(content, HubLoads):
        return tuple(_load_cube(run, content) for run in content.runs.values())
    if isinstance(content, LoadSpectra):
        return tuple(_spectrum_cube(run) for run in content.runs.values())
    if isinstance(content, StoredHistory):
        return (_history_cube(content),)
    if isinstance(content, Transfer):
        return tuple(_unique_names(_response_cube(response, content.geometry.rig) for response in content.responses))
    return ()


def _text(values: Any) -> AnyArray:
    return np.asarray([str(value) for value in values], dtype=object)


def _load_cube(run: RunLoads, loads: HubLoads) -> Cube:
    sigma, sigma_phase = polar_sigma(run.amplitude, run.sigma_cosine, run.sigma_sine)
    axes, count = ("component", "harmonic"), len(run.frequency_hz)

    def over(values: AnyArray, sigma_name: str = "", unit: str = "N, N m") -> Variable:
        return Variable(axes, np.asarray(values).T, unit, sigma_name)

    return Cube(
        name=run.run,
        coordinates={
            "component": Variable(("component",), _text(run.components)),
            "harmonic": Variable(("harmonic",), np.arange(count)),
            "frequency": Variable(("harmonic",), run.frequency_hz, "Hz"),
            "unit": Variable(("component",), _text(UNIT_OF[name] for name in run.components)),
        },
        variables={
            "amplitude": over(np.abs(run.amplitude), "amplitude_sigma"),
            "amplitude_sigma": over(sigma),
            "phase": over(np.degrees(np.angle(run.amplitude)), "phase_sigma", "deg"),
            "phase_sigma": over(sigma_phase, unit="deg"),
            "cosine": over(run.amplitude.real, "cosine_sigma"),
            "cosine_sigma": over(run.sigma_cosine),
            "sine": over(-run.amplitude.imag, "sine_sigma"),
            "sine_sigma": over(run.sigma_sine),
            "flag": over(np.array(run.flags, dtype=object), unit=""),
            "redundancy": Variable(("harmonic",), run.redundancy),
            "condition": Variable(("harmonic",), run.condition),
        },
        signal="amplitude",
        abscissa="harmonic",
        curves="component",
        about={"rig": loads.geometry.rig, "kind": run.kind, "method": loads.method, "response": run.response},
    )


def _spectrum_cube(run: RunSpectra) -> Cube:
    axes = ("component", "frequency")
    units = "N2/Hz, (N m)2/Hz"
    return Cube(
        name=run.run,
        coordinates={
            "component": Variable(("component",), _text(run.components)),
            "frequency": Variable(("frequency",), run.frequency_hz, "Hz"),
        },
        variables={
            "density": Variable(axes, run.density.T, units, "density_sigma"),
            "density_sigma": Variable(axes, run.sigma.T, units),
            "density_noise": Variable(axes, run.noise.T, units),
            "redundancy": Variable(("frequency",), run.redundancy),
            "flag": Variable(("frequency",), np.array(run.flags, dtype=object)),
        },
        signal="density",
        abscissa="frequency",
        curves="component",
        about={"kind": run.kind, "response": run.response, "resolution_hz": run.resolution_hz},
    )


def _history_cube(history: StoredHistory) -> Cube:
    axes = ("component", "time")
    return Cube(
        name=history.run,
        coordinates={
            "component": Variable(("component",), _text(history.components)),
            "time": Variable(("time",), history.time, "s"),
        },
        variables={
            "load": Variable(axes, history.loads.T, "N, N m", "load_sigma"),
            "load_sigma": Variable(axes, history.sigma.T, "N, N m"),
        },
        signal="load",
        abscissa="time",
        curves="component",
        about={"mean": "measured" if history.has_mean else "not measured"},
    )


def _response_cube(response: FrequencyResponse, rig: str) -> Cube:
    axes = ("component", "channel", "frequency")
    channels = np.diagonal(response.channel_covariance, axis1=1, axis2=2).real
    loads = np.diagonal(response.load_covariance, axis1=1, axis2=2).real
    sigma = np.sqrt(channels[:, :, None] * loads[:, None, :])
    values = response.response.transpose(2, 1, 0)
    return Cube(
        name=response.run,
        coordinates={
            "component": Variable(("component",), _text(response.components)),
            "channel": Variable(("channel",), _text(response.channel_names)),
            "frequency": Variable(("frequency",), response.frequency, "Hz"),
        },
        variables={
            "magnitude": Variable(axes, np.abs(values), "V/N, V/(N m)", "response_sigma"),
            "phase": Variable(axes, np.degrees(np.angle(values)), "deg"),
            "response": Variable(axes, values, "V/N, V/(N m)", "response_sigma"),
            "response_sigma": Variable(axes, sigma.transpose(2, 1, 0), "V/N, V/(N m)"),
            "coherence": Variable(axes, response.coherence.transpose(2, 1, 0)),
        },
        signal="magnitude",
        abscissa="frequency",
        curves="channel",
        about={"rig": rig, "estimator": response.estimator},
    )


def _unique_names(cubes: Iterator[Cube]) -> Iterator[Cube]:
    """Yield the cubes; where several have a name, the later ones get a number."""
    from dataclasses import replace

    counts: dict[str, int] = {}
    for cube in cubes:
        counts[cube.name] = counts.get(cube.name, 0) + 1
        yield cube if counts[cube.name] == 1 else replace(cube, name=f"{cube.name}-{counts[cube.name]}")
