"""What `calibrate` says of the gage model, as text and in the JSON summary."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from balance_cli.calibration.all_trims import AllTrimsCalibration, CheckLoads
    from balance_cli.calibration.noniterative import NonIterativeModel
    from balance_cli.calibration.outliers import SuspectLoadSeries
    from balance_cli.calibration.tares import Tares


def math_model_summary(gage: AllTrimsCalibration) -> dict[str, Any]:
    """For the JSON summary."""
    model, channels = gage.model, gage.model.channel_names
    proof = model.contraction()
    return {
        "terms": {name: _nonlinear_terms_summary(gage, c) for c, name in enumerate(channels)},
        "linear": {
            name: dict(zip(model.components, model.coefficients[:, c], strict=False))
            for c, name in _enumerate_channels(gage)
        },
        "full_range": dict(zip(model.components, model.full_range, strict=True)),
        "terms_refused": model.refused,
        "residual": dict(zip(channels, np.sqrt(np.diag(model.residual_covariance)), strict=True)),
        "press": dict(zip(channels, model.press, strict=True)),
        "left_out_sequences": dict(zip(channels, model.left_out, strict=True)),
        "iteration": {
            "contraction": proof.rho if proof.proved else None,
            "proved": proof.proved,
            "reach": dict(zip(model.components, proof.reach, strict=True)),
        },
        "zeros": {
            "sequences": model.sequences,
            "drift_per_sequence": _values_with_sigma(channels, gage.drift.slope, gage.drift.slope_sigma),
            "scatter_chi2_per_dof": dict(zip(channels, gage.drift.scatter, strict=True)),
        },
        "direct": _non_iterative_summary(gage.direct) if gage.direct else None,
        "tares": None if gage.tares is None else _tares_summary(gage.tares, channels),
        "outliers": [vars(suspect) for suspect in gage.outliers],
        "exchanged": gage.exchanged,
        "limits": gage.limits,
        "bad_sequences": [vars(suspect) for suspect in gage.bad_sequences],
        "checks": {check.run: _check_load_summary(check, model.components, model.full_range) for check in gage.checks},
    }


def _enumerate_channels(gage: AllTrimsCalibration) -> Iterator[tuple[int, str]]:
    return enumerate(gage.model.channel_names)


def _nonlinear_terms_summary(gage: AllTrimsCalibration, channel: int) -> dict[str, Mapping[str, float]]:
    """Every term of a channel that is not a load itself, with what is known of it."""
    model = gage.model
    # A matrix from elsewhere states no errors: its t is unknown, too.
    sigma = np.where(np.isfinite(model.t[:, channel]), np.sqrt(np.diag(model.covariance[channel])), np.nan)
    columns = {
        "value": model.coefficients[:, channel],
        "sigma": sigma,
        "t": model.t[:, channel],
        "p": model.p_value[:, channel],
        "variance_inflation": model.variance_inflation[:, channel],
    }
    return {
        name: {what: float(values[i]) for what, values in columns.items()}
        for i, name in enumerate(model.terms)
        if i >= len(model.components) and (np.isfinite(model.t[i, channel]) or columns["value"][i] != 0.0)
    }


def _non_iterative_summary(direct: NonIterativeModel) -> dict[str, Any]:
    """The direct model: what is left, and its terms by load."""
    model, components = direct.model, direct.model.components
    return {
        "residual_percent_fs": dict(zip(components, direct.residual_percent_fs, strict=True)),
        "terms": {name: model.channel_coefficients(name) for name in components},
    }


def _values_with_sigma(names: tuple[str, ...], value: Any, sigma: Any) -> dict[str, dict[str, float]]:
    return {name: {"value": value[i], "sigma": sigma[i]} for i, name in enumerate(names)}


def _tares_summary(tares: Tares, channels: tuple[str, ...]) -> dict[str, Any]:
    return {
        "weight": {"value": tares.weight, "sigma": tares.weight_sigma},
        "centre": _values_with_sigma(("x", "y", "z"), tares.center_of_gravity, tares.center_of_gravity_sigma),
        "natural_zeros": _values_with_sigma(channels, tares.natural_zeros, tares.natural_zeros_sigma),
        "chi2_per_dof": tares.chi2_per_dof,
        "sequences": tares.sequences,
    }


def _check_load_summary(check: CheckLoads, components: tuple[str, ...], full_range: Any) -> dict[str, Any]:
    return {
        "rows": len(check.applied),
        "solved": int(np.count_nonzero(check.solved)),
        "error_percent_fs": dict(zip(components, 100.0 * check.error / full_range, strict=True)),
        "within_interval": dict(zip(components, check.interval_coverage, strict=True)),
    }


def math_model_warnings(gage: AllTrimsCalibration) -> Iterator[str]:
    """What took no part in the fit, and what the iteration cannot promise."""
    for suspect in gage.bad_sequences:
        yield _suspect_series_text(suspect)
    for row in gage.outliers:
        yield (
            f"run {row.run} row {row.row}: {row.channel} is {1e6 * row.error:.3g} uV away from what all others say "
            f"({row.over_sigma:.1f} sigma); the row took no part"
        )
    for pair in gage.exchanged:
        yield f"{pair} read each other's loads throughout: their cables look exchanged"
    yield from gage.limits
    if not gage.model.contraction().proved:
        yield "the iteration for loads is not proved to converge over the range of the calibration; reduce refuses it"


def _suspect_series_text(suspect: SuspectLoadSeries) -> str:
    like = f", as {suspect.like} should" if suspect.like else ""
    other = f"; or it is {' or '.join(suspect.or_else)} that is wrong" if suspect.or_else else ""
    return (
        f"{suspect.sequence}: {suspect.channel} changes {suspect.gain:.4f} +- {suspect.gain_sigma:.4f} times as "
        f"much as the other sequences say{like}; the sequence took no part{other}"
    )


def math_model_text(gage: AllTrimsCalibration) -> Iterator[str]:
    """For the terminal."""
    model = gage.model
    proof = model.contraction()
    if gage.runs:
        yield f"All trims, {len(gage.loads)} rows in {len(model.sequences)} loading sequences, each with its own zero"
    for channel, name in _enumerate_channels(gage):
        terms = _nonlinear_terms_summary(gage, channel)
        said = ", ".join(_term_text(term, of["t"]) for term, of in terms.items()) or "the loads alone"
        yield f"  {name:12s} {said}"
    if proof.proved and model.curved:
        yield f"  loads by iteration: every step shrinks the error at least {1 / max(proof.rho, 1e-12):.0f} times"
    if gage.direct is not None:
        left = ", ".join(
            f"{name} {value:.4f}" for name, value in zip(model.components, gage.direct.residual_percent_fs, strict=True)
        )
        yield f"  direct, without iteration; residual % FS: {left}"
    if gage.tares is not None:
        yield from _tares_text(gage.tares)
    if model.refused:
        yield f"  {len(model.refused)} terms that these loads do not support, {_first_refusal_text(model.refused)}"
    for check in gage.checks:
        outside = len(check.solved) - int(np.count_nonzero(check.solved))
        left = f"; {outside} of {len(check.solved)} rows outside the calibrated loads are left out" if outside else ""
        yield f"  {check.run}: rms error % FS, and loads within their 95 % interval{left}"
        for j, component in enumerate(model.components):
            error, share = 100.0 * check.error[j] / model.full_range[j], 100.0 * check.interval_coverage[j]
            yield f"    {component:4s} {error:9.4f} {share:6.1f} %"


def _tares_text(tares: Tares) -> Iterator[str]:
    yield f"  metric part: weight {tares.weight:.6g} +- {tares.weight_sigma:.2g} N, which the loads of the model hold"
    if np.isfinite(tares.center_of_gravity).all():
        each = zip("xyz", 1e3 * tares.center_of_gravity, 1e3 * tares.center_of_gravity_sigma, strict=True)
        place = ", ".join(f"{axis} {value:.5g} +- {sigma:.2g}" for axis, value, sigma in each)
        yield f"    its centre of gravity from the hub [mm]: {place}"
    yield f"    zeros of {tares.sequences} sequences about it: chi2/dof {tares.chi2_per_dof:.2f}"


def _term_text(term: str, t: float) -> str:
    return f"{term} (t {t:.1f})" if np.isfinite(t) else term


def _first_refusal_text(refused: Mapping[str, str]) -> str:
    name, reason = next(iter(refused.items()))
    return f"as {name}: {reason}"
