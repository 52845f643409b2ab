"""Identifiability: whether data or prior inform an estimate, and what the data alone do not determine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.parameters import ParameterSet

Array = NDArray[np.float64]

# Components of a direction below this share of the largest are not named: they do not change what the direction is.
MIN_RELATIVE_CHANGE = 0.05


@dataclass(frozen=True)
class Identifiability:
    """`informed_by` of every parameter, and the effective number of parameters that the data determine."""

    informed_by: tuple[str, ...]
    effective_parameters: float


def parameter_identifiability(parameters: ParameterSet, information: Array) -> Identifiability:
    """Split the variance of the estimate by its source; `information` (free, free) is that of the data alone.

    With precision P of the priors and covariance C = (information + P)^-1, C = C information C + C P C: the first
    part comes from the noise, the second from the error of the declared values. A parameter is informed by `prior`
    where the second part is more than half of its variance, `exact` without a tolerance, else informed by `data`.
    """
    free = parameters.free
    precision = np.diag(1.0 / parameters.sigma[free] ** 2)
    covariance = covariance_from_information(information + precision)
    variance = np.diag(covariance)
    share = np.diag(covariance @ precision @ covariance) / np.where(variance > 0, variance, 1.0)
    sources = iter(["prior" if part > 0.5 else "data" for part in share])
    informed_by = tuple(next(sources) if is_free else "exact" for is_free in free)
    return Identifiability(informed_by, float(np.trace(covariance @ information)))


def covariance_from_information(information: Array) -> Array:
    """Inverse (p, p) of an information matrix; zero for a parameter without information.

    The matrix is scaled to a unit diagonal first. Along a direction whose information is only rounding error the
    variance is large, not infinite.
    """
    informed = np.flatnonzero(np.diag(information) > 0)
    size = 1.0 / np.sqrt(np.diag(information)[informed])
    values, vectors = np.linalg.eigh(information[np.ix_(informed, informed)] * np.outer(size, size))
    least = np.finfo(float).eps * max(len(informed), 1)
    covariance = np.zeros(information.shape)
    inverse = (vectors / np.maximum(values, least)) @ vectors.T
    covariance[np.ix_(informed, informed)] = inverse * np.outer(size, size)
    return covariance


def unidentifiable_directions(parameters: ParameterSet, information: Array) -> tuple[str, ...]:
    """Directions in which the data have less information than the priors, as text: `+0.3 mass +0.3 stiffness.x ...`.

    The directions are relative changes of the parameters (relative to the prior sigma where that exceeds the value). An
    eigenvalue of the information in units of the priors below 1 means that the prior dominates.
    """
    free = parameters.free
    sigma = np.where(np.isfinite(parameters.sigma[free]), parameters.sigma[free], parameters.scale[free])
    values, vectors = np.linalg.eigh(information * np.outer(sigma, sigma))
    names = [name for name, is_free in zip(parameters.names, free, strict=True) if is_free]
    size = np.maximum(np.abs(parameters.value[free]), sigma)
    return tuple(_format_direction(names, vectors[:, i] * sigma / size) for i in np.flatnonzero(values < 1.0))


def _format_direction(names: list[str], change: Array) -> str:
    relative = change / change[np.argmax(np.abs(change))]
    large = [i for i in np.argsort(-np.abs(relative)) if abs(relative[i]) > MIN_RELATIVE_CHANGE]
    return " ".join(f"{relative[i]:+.2f} {names[i]}" for i in large)
