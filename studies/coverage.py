"""Coverage of the 95 % intervals over fits with new parameters and new noise each.

The response of a rig to noise-free multisines is simulated in time once (and scaled for the lower level, exact for a
linear rig). Every fit then sees declared values drawn about the truth by the tolerances, and new noise in every period.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.identifiability import parameter_identifiability
from balance_cli.estimation.maximum_likelihood import fit_maximum_likelihood
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from balance_cli.signals.covariance_pooling import pooled_covariance
from balance_cli.signals.run_spectrum import RunSpectrum, StaticPoints
from balance_cli.simulation import Noise, draw_rig, simulate_run
from balance_cli.simulation.plans import StaticPlan, SweepPlan
from balance_cli.simulation.preset_plans import campaign_plan
from balance_cli.simulation.rig import TrueRig
from tests.support.truth import true_parameters

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

PERIODS = 3
Z_95 = 1.959963984540054


def noise_free_measurements(rig: TrueRig, seed: int) -> list[RunSpectrum | StaticPoints]:
    """Steady lines of every sweep and rows of every static run of the standard campaign, without noise."""
    assert rig.geometry.rotor is not None
    data: list[RunSpectrum | StaticPoints] = []
    for plan in campaign_plan("standard", rig.geometry.rotor.speed).runs:
        if isinstance(plan, StaticPlan):
            data.append(_noise_free_points(rig, plan, seed))
        elif isinstance(plan, SweepPlan):
            data.append(_steady_lines(rig, plan, seed))
    return data


def _noise_free_points(rig: TrueRig, plan: StaticPlan, seed: int) -> StaticPoints:
    run, _ = simulate_run(rig, plan, Noise().scale_by(0.0), seed)
    block = run.read()
    assert block.loads is not None
    names = run.channel_names
    return StaticPoints(run.name, plan.trim, names, block.channels, block.loads, np.eye(len(names)), np.inf)


def _steady_lines(rig: TrueRig, plan: SweepPlan, seed: int) -> RunSpectrum:
    """The last of many periods, without transient."""
    run, _ = simulate_run(rig, plan.model_copy(update={"periods": 14}), Noise().scale_by(0.0), seed)
    samples = round(plan.period * plan.sample_rate)
    block = run.read(run.samples - samples, run.samples)
    assert block.loads is not None
    frequency = np.fft.rfftfreq(samples, 1 / plan.sample_rate)
    U, Y = (np.fft.rfft(x, axis=0) * 2 / samples for x in (block.loads, block.channels))
    column = int(np.argmax(np.abs(U).max(axis=0)))
    excited = np.abs(U[:, column]) > 1e-3 * np.abs(U[:, column]).max()
    size = len(run.channel_names) + 1
    covariance = np.zeros((int(excited.sum()), size, size), complex)
    loads = U[excited][:, [column]]
    return RunSpectrum(
        run.name, run.channel_names, run.excited, frequency[excited], Y[excited], loads, covariance, np.inf
    )


def add_noise(
    noise_free_data: RunSpectrum | StaticPoints, geometry: Geometry, rng: np.random.Generator
) -> RunSpectrum | StaticPoints:
    """Add noise as recorded: three periods of a sweep, every row of a static run."""
    return (
        _add_noise_to_points(noise_free_data, rng)
        if isinstance(noise_free_data, StaticPoints)
        else _add_noise_to_lines(noise_free_data, geometry, rng)
    )


def _add_noise_to_points(noise_free_data: StaticPoints, rng: np.random.Generator) -> StaticPoints:
    """Noise on readings and loads; its covariance as estimated from the second differences of the rows."""
    noise = Noise()
    rows, c = noise_free_data.channels.shape
    channels = noise_free_data.channels + noise.static_channel * rng.standard_normal((rows, c))
    read = noise_free_data.loads + noise.static_load * rng.standard_normal((rows, 6))
    C0 = np.linalg.lstsq(
        noise_free_data.loads - noise_free_data.loads.mean(0),
        noise_free_data.channels - noise_free_data.channels.mean(0),
        rcond=None,
    )[0].T
    true = np.eye(c) * noise.static_channel**2 + noise.static_load**2 * C0 @ C0.T
    dof = rows // 2
    deviations = rng.multivariate_normal(np.zeros(c), true, size=dof)
    return replace(
        noise_free_data, channels=channels, loads=read, covariance=deviations.T @ deviations / dof, dof=dof / 2
    )


def _add_noise_to_lines(noise_free_data: RunSpectrum, geometry: Geometry, rng: np.random.Generator) -> RunSpectrum:
    """Noise of three periods; the covariance of their mean from their scatter, as `periodic_spectrum` estimates it."""
    noise = Noise()
    samples = 3200
    by_name = {channel.name: channel for channel in geometry.channels}
    sigma = np.array([noise.sigma_of_channel(by_name[name]) for name in noise_free_data.channel_names] + [noise.load])
    # E|X|^2 of X = 2/N sum x exp(-j w t) is 4 sigma^2 / N.
    per_part = sigma * np.sqrt(2.0 / samples)
    shape = (PERIODS, len(noise_free_data.frequency), len(sigma))
    z = per_part * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
    mean = z.mean(axis=0)
    deviation = z - mean
    pooled = pooled_covariance(deviation.swapaxes(0, 1), np.full(len(mean), PERIODS - 1.0))
    c = len(noise_free_data.channel_names)
    return replace(
        noise_free_data,
        channels=noise_free_data.channels + mean[:, :c],
        loads=noise_free_data.loads + mean[:, c:],
        covariance=pooled.at_lines / PERIODS,
        dof=pooled.dof,
    )


@dataclass(frozen=True)
class CoverageTask:
    """One rig (by its seed) and the number of its fits."""

    seed: int
    fits: int


def coverage_chunk(geometry: Geometry, task: CoverageTask) -> pd.DataFrame:
    """Estimate minus truth in units of sigma for every fitted parameter, one row a fit and parameter."""
    rng = np.random.default_rng([task.seed, 1985])
    rig = draw_rig(geometry, rng)
    noise_free_data = noise_free_measurements(rig, task.seed)
    model = balance_model(geometry)
    parameters = model.parameters
    truth = true_parameters(rig, parameters)
    rows = []
    for fit in range(task.fits):
        measured = [add_noise(item, geometry, rng) for item in noise_free_data]
        lines = [item for item in measured if isinstance(item, RunSpectrum)]
        points = [item for item in measured if isinstance(item, StaticPoints)]
        declared = truth + parameters.sigma * rng.standard_normal(len(truth))
        shifted = replace(model, parameters=replace(parameters, value=declared))
        minimum = fit_maximum_likelihood(shifted, stack_runs(lines, points, geometry.channel_names), truth)
        sigma = np.sqrt(np.diag(np.linalg.inv(minimum.total.information)))
        error = (minimum.theta - truth)[parameters.free] / sigma
        identifiability = parameter_identifiability(parameters, minimum.data.information)
        sources = [source for source in identifiability.informed_by if source != "exact"]
        names = [name for name, free in zip(parameters.names, parameters.free, strict=True) if free]
        rows += [
            {"seed": task.seed, "fit": fit, "parameter": name, "rests_on": source, "error": value}
            for name, source, value in zip(names, sources, error, strict=True)
        ]
    return pd.DataFrame(rows)


def coverage_table(errors: pd.DataFrame) -> pd.DataFrame:
    """Fraction of 95 % intervals that contain the truth, by parameter, with three binomial standard errors."""
    covered = errors.assign(covered=errors["error"].abs() < Z_95)
    table = covered.groupby("parameter", sort=False)["covered"].agg(["mean", "size"])
    table.insert(0, "rests_on", covered.groupby("parameter")["rests_on"].agg(lambda words: words.mode()[0]))
    table = table.rename(columns={"mean": "coverage", "size": "fits"}).reset_index()
    table["three_sigma"] = 3 * np.sqrt(0.95 * 0.05 / table["fits"])
    return table.sort_values("rests_on", kind="stable")
