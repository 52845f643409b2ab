"""Responses to hub loads from forces at points beside the hub, such as taps of a hammer.

A force at a point drives the hub loads a_r = (direction, arm x direction) at once: its response is h_r = T a_r. Several
of them, in directions and at points that span the hub loads, give T = H A^+ at every line, weighted by their noise.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.io.errors import UserError
from balance_cli.io.result_view import plural
from balance_cli.signals.response.periodic_response import run_difference_ratio
from balance_cli.signals.response.transfer import select_channels
from balance_cli.signals.run_samples import LARGEST_LOAD_CONDITION, combination_text
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LARGEST_GAP = 2.5
"""Between two lines about a line of another record, in steps of the coarser one; wider gaps are not bridged."""
LEAST_COMMON = 0.5
"""Share of those lines from which the ones that all records have serve: records of one length share nearly all."""
INTERPOLATION = "spline"
"""The lines of a tap of seconds lie within the width of a mode; local models of thousands of lines take minutes."""


@dataclass(frozen=True)
class PointForce:
    """The response (k, c, 1) to a force at a point, and the hub loads (6,) per unit of the load to which it refers."""

    response: FrequencyResponse
    multiples: Array


def combine_point_forces(forces: Sequence[PointForce]) -> FrequencyResponse:
    """Return the response to the hub loads that R forces at points span, with that of their noise and differences.

    The lines are those of the coarsest record that lie within the lines of all. Raises UserError where the forces do
    not span the hub loads that they drive, or have no lines in common.
    """
    multiples = np.array([force.multiples for force in forces]).T
    driven = np.any(multiples != 0.0, axis=1)
    A = multiples[driven]
    names = tuple(name for name, is_driven in zip(COMPONENTS, driven, strict=True) if is_driven)
    _require_span(A, names, forces)
    responses = _at_common_lines([force.response for force in forces])
    H = np.concatenate([response.response for response in responses], axis=2)
    covariance = np.stack(
        [item.channel_covariance * item.load_covariance[:, :1, :1].real for item in responses], axis=1
    )
    return _solve(H, covariance, A, names, responses)


def _solve(
    H: ComplexArray, covariance: ComplexArray, A: Array, names: tuple[str, ...], responses: list[FrequencyResponse]
) -> FrequencyResponse:
    """Solve H = T A (k, c, R) by weighted least squares; `covariance` (k, R, c, c) of each column.

    The covariance is separable where those of the forces differ by a factor alone; else it is that of their mean shape.
    """
    size = _relative_variance(covariance)
    white = A[None] / np.sqrt(size)[:, None, :]
    inverse = np.linalg.pinv(white)
    whitened = H / np.sqrt(size)[:, None, :]
    T = whitened @ inverse
    noise = np.mean(covariance / size[:, :, None, None], axis=1)
    excess = np.sqrt(run_difference_ratio(whitened - T @ white, noise, A.shape[1] - len(names)))
    first = responses[0]
    ordinary, multiple = _coherences(responses, A)
    return replace(
        first,
        run="+".join(response.run for response in responses),
        components=names,
        response=T,
        channel_covariance=noise * excess[:, :, None] * excess[:, None, :],
        load_covariance=(inverse.swapaxes(1, 2) @ inverse).astype(complex),
        coherence=ordinary,
        multiple_coherence=multiple,
        level=_levels(responses, A),
        noise_dof=_least([item.noise_dof for item in responses]),
        line_share=_least([item.line_share for item in responses]),
    )


def _least(values: Sequence[Any]) -> Any:
    """Return the least of numbers or arrays, without those that are None; None where all are."""
    known = [value for value in values if value is not None]
    return functools.reduce(np.minimum, known) if known else None


def _levels(responses: list[FrequencyResponse], A: Array) -> tuple[float, ...]:
    """Return the rms of each load over the records (R,), of which each states that of the load to which it refers."""
    stated = np.array([response.level[0] if response.level else np.nan for response in responses])
    return tuple(np.sqrt(np.mean((A * stated) ** 2, axis=1)).tolist())


def _relative_variance(covariance: ComplexArray) -> Array:
    """Return the variance (k, R) of each column over the mean of all, averaged over the channels; 1 without noise."""
    variance = np.maximum(np.einsum("krcc->krc", covariance).real, 0.0)
    mean = variance.mean(axis=1, keepdims=True)
    size = np.mean(np.divide(variance, mean, out=np.ones_like(variance), where=mean > 0), axis=2)
    return np.where(size > 0, size, 1.0)


def _coherences(responses: list[FrequencyResponse], A: Array) -> tuple[Array, Array]:
    """Return coherence (k, c, u) and multiple coherence (k, c): means of the forces, by their share in each load."""
    share = np.abs(A) / np.abs(A).sum(axis=1, keepdims=True)
    each = np.stack([response.coherence[:, :, 0] for response in responses], axis=2)
    return each @ share.T, each.mean(axis=2)


def _at_common_lines(responses: list[FrequencyResponse]) -> list[FrequencyResponse]:
    """Return the responses of the channels that all have at the lines of the coarsest record."""
    channels = [name for name in responses[0].channel_names if all(name in item.channel_names for item in responses)]
    responses = [select_channels(response, channels) for response in responses]
    coarsest = max(responses, key=lambda item: _step(item.frequency))
    covered = common = coarsest.frequency
    for item in responses:
        covered = covered[_is_covered(covered, item.frequency, LARGEST_GAP * _step(coarsest.frequency))]
        common = common[np.isin(common, item.frequency)]
    lines = common if len(common) >= LEAST_COMMON * len(covered) else covered
    if not len(lines):
        runs = ", ".join(item.run for item in responses)
        fault = "the records of forces at points have no frequencies in common"
        raise UserError(fault, f"runs {runs}", remedy="Use records of one sample rate and of like lengths")
    return [_select_lines(item, lines) if lines is common else _interpolate(item, lines) for item in responses]


def _step(frequency: Array) -> float:
    return float(np.median(np.diff(frequency))) if len(frequency) > 1 else 0.0


def _is_covered(lines: Array, others: Array, gap: float) -> NDArray[np.bool_]:
    """Return which lines (k,) lie on others (l,), or between two of them that are no farther apart than `gap`."""
    above = np.searchsorted(others, lines)
    low, high = others[np.maximum(above - 1, 0)], others[np.minimum(above, len(others) - 1)]
    between = (lines >= low) & (lines <= high) & (high - low <= gap)
    return np.asarray(between | np.isin(lines, others))


def _select_lines(response: FrequencyResponse, lines: Array) -> FrequencyResponse:
    keep = np.isin(response.frequency, lines)
    return response.select(keep)


def _interpolate(response: FrequencyResponse, lines: Array) -> FrequencyResponse:
    """Return the response at other lines, with the error of the interpolation; its coherence is that of a neighbor."""
    from balance_cli.signals.response.interpolation_error import interpolate_with_error

    value = interpolate_with_error(response, lines, INTERPOLATION)
    nearest = np.argmin(np.abs(response.frequency - lines[:, None]), axis=1)
    return replace(
        response,
        frequency=lines,
        response=value.value,
        channel_covariance=value.channel_covariance,
        load_covariance=value.load_covariance,
        coherence=response.coherence[nearest],
        multiple_coherence=response.multiple_coherence[nearest],
        line_share=None if response.line_share is None else response.line_share[nearest],
    )


def _require_span(A: Array, names: tuple[str, ...], forces: Sequence[PointForce]) -> None:
    """Raise UserError where a combination of the driven loads (u, R) is never driven, or hardly."""
    is_force = np.array([name.startswith("F") for name in names])
    scale = np.ones(len(names))
    for group in (is_force, ~is_force):
        if group.any():
            scale[group] = float(np.linalg.norm(A[group])) or 1.0
    left, singular, _ = np.linalg.svd(A / scale[:, None])
    rank = int(np.sum(singular > singular[0] / LARGEST_LOAD_CONDITION))
    if rank == len(names):
        return
    runs = ", ".join(force.response.run for force in forces)
    missing = combination_text(left[:, -1] / scale, names)
    few = plural(len(forces), "force")
    fault = (
        f"{few} at points drove {len(names)} hub loads in {plural(rank, 'combination')}: nothing drove {missing} alone"
    )
    remedy = "Tap or drive further points, in directions that differ, or use `identify`, which needs fewer"
    raise UserError(fault, f"runs {runs}", remedy=remedy)
