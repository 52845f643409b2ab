"""Static calibration compared with sweeps at low frequency; they differ where something creeps, slips or bends.

Below the lowest mode a response is a power series: its real part in w^2, its imaginary part w times one,

    y / g = sum_j u_j sum_n (a_jn + j (f/f1) b_jn) (f/f1)^2n.

The first terms are free. The higher ones, which few lines determine, are limited to the size of the response itself
(each mode at f_m contributes its share times (f1/f_m)^2n), so that their effect is part of the uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.data_test_settings import DataTestSettings, StaticPairSettings
from balance_cli.diagnosis.data_tests.channel_pairs import declared_paths
from balance_cli.diagnosis.result import ModelFreeTest
from balance_cli.diagnosis.significance import combined_dof, format_with_sigma, hotelling_p_value
from balance_cli.io.percent import percent_text
from balance_cli.model.channel_gains import channel_gains
from balance_cli.model.mechanics.equations import ChannelPath
from balance_cli.signals.run_spectrum import RunSpectrum, StaticPoints

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

STATIC_TEST_NAME = "static against low frequency"


@dataclass(frozen=True)
class _StaticResponse:
    """Response at rest to one component, forces per unit load: value (c,), covariance (c, c), dof of the noise."""

    channels: tuple[str, ...]
    value: Array
    covariance: Array
    dof: float


def static_tests(
    runs: Sequence[RunSpectrum],
    statics: Sequence[StaticPoints],
    geometry: Geometry,
    lowest_mode: float,
    settings: DataTestSettings,
) -> list[ModelFreeTest]:
    """One row for each static run and component that a sweep has, too."""
    dynamic = _extrapolate_responses(runs, geometry, lowest_mode, settings.static_pairs)
    rows = []
    for points in statics:
        for component, response in _static_responses(points, geometry, settings.static_pairs.max_condition).items():
            if component in dynamic:
                rows.append(_test(f"{points.run}: {component}", response, dynamic[component], settings))
    return rows


def _static_responses(points: StaticPoints, geometry: Geometry, max_condition: float) -> dict[str, _StaticResponse]:
    """The linear response of a static run to each component that varies in it."""
    varied = np.flatnonzero(np.ptp(points.loads, axis=0) > 0)
    gain = {channel.name: channel.sensitivity for channel in geometry.channels}
    gains = np.array([gain[name] for name in points.channel_names])
    Q, R = np.linalg.qr((points.loads - points.loads.mean(axis=0))[:, varied])
    if not len(varied) or np.linalg.cond(R) > max_condition:
        return {}
    inverse = np.linalg.inv(R)
    coefficients = inverse @ (Q.T @ (points.channels / gains))
    noise = points.covariance / np.outer(gains, gains)
    return {
        COMPONENTS[j]: _StaticResponse(
            points.channel_names, coefficients[i], inverse[i] @ inverse[i] * noise, points.dof
        )
        for i, j in enumerate(varied)
    }


def _extrapolate_responses(
    runs: Sequence[RunSpectrum], geometry: Geometry, lowest_mode: float, settings: StaticPairSettings
) -> dict[str, _StaticResponse]:
    """Responses at frequency zero to each swept component; the weighted mean of several runs."""
    by_component: dict[str, list[_StaticResponse]] = {}
    dc = [path for path in declared_paths(geometry) if not path.high_pass]
    for run in runs:
        similar_runs = sum(candidate.components == run.components for candidate in runs)
        for component, response in _extrapolate_run(run, dc, lowest_mode, similar_runs, settings).items():
            by_component.setdefault(component, []).append(response)
    return {component: _mean(responses) for component, responses in by_component.items()}


def _extrapolate_run(
    run: RunSpectrum,
    dc: Sequence[ChannelPath],
    lowest_mode: float,
    similar_runs: int,
    settings: StaticPairSettings,
) -> dict[str, _StaticResponse]:
    """Responses of one run at frequency zero; the error of higher terms is the same in all similar runs.

    None where its loads are one force at a point beside the hub: their responses are not told apart.
    """
    low = np.flatnonzero((run.frequency > 0) & (run.frequency <= settings.max_frequency_share * lowest_mode))
    dc = [path for path in dc if path.channel in run.channel_names]
    u = len(run.components)
    if len(low) < settings.min_lines * u or not dc or not _are_independent(run.loads[low], settings.max_condition):
        return {}
    c = len(run.channel_names)
    signals = np.array([*(run.channel_names.index(path.channel) for path in dc), *range(c, c + u)])
    gains = np.concatenate([channel_gains(dc, run.frequency[low]), np.ones((len(low), u))], axis=1)
    z = np.concatenate([run.channels, run.loads], axis=1)[low[:, None], signals] / gains
    noise = run.covariance[low[:, None, None], signals[:, None], signals] / (gains[:, :, None] * gains[:, None].conj())
    value, covariance = _fit_power_series(run.frequency[low] / lowest_mode, z, noise, u, similar_runs, settings)
    names = tuple(path.channel for path in dc)
    return {
        component: _StaticResponse(names, value[j], covariance[j], 2.0 * run.dof)
        for j, component in enumerate(run.components)
    }


def _are_independent(loads: ComplexArray, max_condition: float) -> bool:
    """Whether the loads (K, u) of lines are of other proportions from line to line."""
    size = np.linalg.norm(loads, axis=0)
    return bool(np.all(size > 0.0) and np.linalg.cond(loads / size) < max_condition)


def _fit_power_series(
    x: Array, z: ComplexArray, noise: ComplexArray, u: int, similar_runs: int, settings: StaticPairSettings
) -> tuple[Array, Array]:
    """Terms of order zero (u, c) and their covariance (u, c, c) from forces and loads z (K, c+u) at x = f/f1 (K,).

    The noise of the loads is transformed by the response of a first fit.
    """
    c = z.shape[1] - u
    forces, loads = z[:, :c], z[:, c:]
    terms = settings.terms
    columns = _columns(x, loads, terms)
    force_noise = noise[:, :c, :c]
    size = np.sqrt(np.mean(np.abs(forces) ** 2) / np.mean(np.sum(np.abs(loads) ** 2, axis=1)))
    for _ in range(2):
        _, _, value = _solve_series(columns, forces, force_noise, size, u, settings)
        response = np.einsum("kn,ujnc->kcu", x[:, None] ** (2 * np.arange(terms)), value.reshape(u, 2, terms, c)[:, :1])
        combine = np.concatenate([np.broadcast_to(np.eye(c), (len(x), c, c)), -response], axis=2)
        force_noise = combine @ noise @ combine.swapaxes(1, 2)
        size = max(float(np.abs(value.reshape(u, 2, terms, c)[:, 0, 0]).max()), np.finfo(float).tiny)
    kernel, prior, value = _solve_series(columns, forces, force_noise, size, u, settings)
    rest = [2 * terms * j for j in range(u)]
    covariance = (
        0.5 * np.einsum("cjk,kcd,djk->jcd", kernel[:, rest].conj(), force_noise, kernel[:, rest], optimize=True).real
    )
    covariance += similar_runs * np.stack([np.diag(prior[:, place]) for place in rest])
    return value[rest], covariance


def _columns(x: Array, loads: ComplexArray, count: int) -> ComplexArray:
    """Each load times each term, (K, 2 u count): even ones first, then odd ones."""
    even = x[:, None] ** (2 * np.arange(count))
    terms = np.concatenate([even.astype(complex), 1j * x[:, None] * even], axis=1)
    return np.asarray((loads[:, :, None] * terms[:, None, :]).reshape(len(x), -1))


def _solve_series(
    columns: ComplexArray,
    forces: ComplexArray,
    noise: ComplexArray,
    size: float,
    u: int,
    settings: StaticPairSettings,
) -> tuple[ComplexArray, Array, Array]:
    """Kernel (c, q, K), prior variance (c, q) and coefficients (q, c) = Re sum_k kernel* force.

    The prior variance is the part of the variance due to the limit on the higher terms.
    """
    variance = np.diagonal(noise, axis1=1, axis2=2).real
    held = np.tile(np.arange(settings.terms) >= settings.free_terms, 2 * u)
    weighted = columns.T[None] / variance.T[:, None, :]
    information = np.real(2.0 * weighted @ columns.conj()) + np.diag(np.where(held, 1.0 / size**2, 0.0))
    scale = 1.0 / np.sqrt(np.diagonal(information, axis1=1, axis2=2))
    normal = information * scale[:, :, None] * scale[:, None, :]
    inverse = np.linalg.inv(normal) * scale[:, :, None] * scale[:, None, :]
    kernel = np.asarray(2.0 * inverse @ weighted)
    value = np.real(np.einsum("cqk,kc->qc", kernel.conj(), forces))
    prior = np.sum(inverse[:, :, held] ** 2, axis=2) / size**2
    return kernel, prior, value


def _mean(responses: Sequence[_StaticResponse]) -> _StaticResponse:
    """The mean, weighted by noise, of the responses with the channels of the first one."""
    same = [response for response in responses if response.channels == responses[0].channels]
    precision = [np.linalg.inv(response.covariance) for response in same]
    covariance = np.linalg.inv(sum(precision))
    value = covariance @ sum(P @ response.value for P, response in zip(precision, same, strict=True))
    return _StaticResponse(same[0].channels, value, covariance, sum(response.dof for response in same))


def _test(place: str, static: _StaticResponse, dynamic: _StaticResponse, settings: DataTestSettings) -> ModelFreeTest:
    """Hotelling's test of the difference, over the channels that both have."""
    names = [name for name in static.channels if name in dynamic.channels]
    c = len(names)
    parts = [_extract_channels(response, names) for response in (static, dynamic)]
    covariance = parts[0][1] + parts[1][1]
    difference = parts[0][0] - parts[1][0]
    share = float(np.trace(np.linalg.solve(covariance, parts[0][1]))) / c
    dof = min(combined_dof((share, 1.0 - share), (static.dof, dynamic.dof)), settings.static_pairs.max_dof)
    squared = float(difference @ np.linalg.solve(covariance, difference))
    p_value = hotelling_p_value(squared, c, dof)
    finding = "equal" if p_value > settings.significance_level else _finding(names, parts, covariance)
    return ModelFreeTest(STATIC_TEST_NAME, place, squared * max(dof - c - 1.0, 1.0) / dof, float(c), p_value, finding)


def _extract_channels(response: _StaticResponse, names: Sequence[str]) -> tuple[Array, Array]:
    places = [response.channels.index(name) for name in names]
    return response.value[places], response.covariance[np.ix_(places, places)]


def _finding(names: Sequence[str], parts: Sequence[tuple[Array, Array]], covariance: Array) -> str:
    """The total difference, and the channel that differs most."""
    static, dynamic = parts[0][0], parts[1][0]
    sigma = np.sqrt(np.diag(covariance))
    worst = int(np.argmax(np.abs(static - dynamic) / sigma))
    relative_difference = float(np.linalg.norm(static - dynamic) / np.linalg.norm(static))
    change = format_with_sigma(static[worst] - dynamic[worst], sigma[worst])
    return f"differs by {percent_text(relative_difference)} %; most in {names[worst]}: {change} of {static[worst]:.4g}"
