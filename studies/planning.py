"""What `balance plan` predicts, against what simulated campaigns achieve: detection rate and sigma of parameters.

Each campaign has one effect of the smallest size that the plan says is found 90 % of the time. It is found where its
own score is significant at the level that a diagnosis of all candidates uses. Of some campaigns the whole diagnosis is
made, too: it has found the effect where it accepts one of its name and place, or one that it calls indistinguishable.

The rig is integrated in time without noise, once for each chunk of campaigns; then each of them gets noise of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pandas as pd
from scipy import stats

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.geometry import DeclaredEffect, Geometry
from balance_cli.diagnosis.search.candidates import Candidate, candidate_at
from balance_cli.diagnosis.search.score_statistics import scores
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.diagnosis.significance import bonferroni_p_value
from balance_cli.estimation.identifiability import covariance_from_information
from balance_cli.estimation.maximum_likelihood import fit_maximum_likelihood
from balance_cli.estimation.measured_spectra import Spectra, measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from balance_cli.planning.candidate_runs import candidate_runs
from balance_cli.planning.detectability import DetectionLevel, SmallestSize, project, smallest_sizes
from balance_cli.planning.hall import Hall
from balance_cli.planning.information import add_information, no_information
from balance_cli.simulation import CampaignPlan, simulate_campaign, true_rig
from balance_cli.simulation.noise import NO_NOISE, Noise
from balance_cli.simulation.rig import apply_effects
from balance_cli.steps.diagnose import diagnose
from balance_cli.steps.identify import identify
from balance_cli.steps.plan import PlanningRig, PlanOptions, line_powers, planning_rig
from tests.support.other_rigs import other_rig, short_campaign

REHEARSALS = 4
LEAST_INFORMED = 0.5
"""Predicted sigma over the declared one, below which a parameter is informed by data, and its sigma compared."""
RIG, EXCITED = "A", ("Fx", "Fz", "My")
CHUNKS, REPETITIONS = 5, 40
DIAGNOSES = 5
"""Campaigns of each class that are diagnosed as a whole."""


@dataclass(frozen=True)
class PlannedClass:
    """One effect: its place, the parameter that has a size, and the word that the effect needs besides."""

    effect: str
    where: tuple[str, ...]
    parameter: str
    choice: tuple[str, str] | None = None

    @property
    def label(self) -> str:
        """NAME@PLACE."""
        return f"{self.effect}@{','.join(self.where)}"


CLASSES = (
    PlannedClass("structural-damping", ("l1",), "loss_factor"),
    PlannedClass("crosstalk", ("l2.strain", "l1.strain"), "fraction"),
    PlannedClass("cell-misalignment", ("l3",), "angle_1"),
    PlannedClass("time-delay", ("l5.piezo",), "delay"),
    PlannedClass("cubic-stiffness", ("l1", "inside"), "k3", ("side", "inside")),
)


@dataclass(frozen=True)
class Forecast:
    """A plan of one sweep of each component, and what it predicts."""

    base: PlanningRig
    plan: CampaignPlan
    sigma: dict[str, float]
    sizes: dict[tuple[str, str], SmallestSize]


@lru_cache
def forecast() -> Forecast:
    """The plan and its forecast, the same for all campaigns."""
    geometry, options = other_rig(RIG), PlanOptions(minutes=60.0, hall=_hall())
    base = planning_rig(geometry, options.hall)
    powers = line_powers(base, options, no_information(base.model))
    runs = candidate_runs(geometry, options.hall, base.settings, base.model.system, powers)
    information = [base.information(item.plan, range(1000, 1000 + REHEARSALS)) for item in runs]
    projected = project(add_information(information, base.model), base.model)
    names = np.array(base.model.model.parameters.names)[base.model.model.parameters.free][base.model.indices.fitted]
    sigma = dict(zip(names.tolist(), np.sqrt(np.diag(projected.covariance)).tolist(), strict=True))
    sizes = {(item.label, item.parameter): item for item in smallest_sizes(projected, base.model, DetectionLevel())}
    return Forecast(base, CampaignPlan(runs=tuple(item.plan for item in runs)), sigma, sizes)


def _hall() -> Hall:
    sweeps = [run for run in short_campaign(RIG).runs if run.kind == "sweep" and run.excited[0] in EXCITED]
    return Hall(
        format="balance-hall/1",
        exciters={run.excited[0]: {"rms": run.level[0]} for run in sweeps},
        band=sweeps[0].band,
        sample_rate=sweeps[0].sample_rate,
        period=1.0,
        periods=(5,),
        levels=(1.0,),
        effects=tuple({item.effect for item in CLASSES}),
    )


def planning_chunk(seed: int) -> pd.DataFrame:
    """REPETITIONS campaigns of each class, from one integration without noise."""
    return pd.concat([pd.DataFrame(_campaigns(item, seed)) for item in CLASSES], ignore_index=True)


def _campaigns(item: PlannedClass, seed: int) -> Iterator[dict[str, object]]:
    geometry, size = other_rig(RIG), forecast().sizes[item.label, item.parameter]
    candidate = candidate_at(item.effect, item.where, geometry)
    null = next(each.null for each in candidate.placed_effect.parameters if each.name == item.parameter)
    where = item.where if item.choice is None else item.where[:-1]
    values: dict[str, float | str] = {item.parameter: null + size.value, **dict([item.choice] if item.choice else [])}
    rig = apply_effects(true_rig(geometry), [DeclaredEffect(name=item.effect, where=where, parameters=values)])
    clean, _ = simulate_campaign(rig, forecast().plan, NO_NOISE, seed)
    for repetition in range(REPETITIONS):
        campaign = seed * REPETITIONS + repetition
        runs = [_add_noise(run, geometry, np.random.default_rng([campaign, k])) for k, run in enumerate(clean)]
        spectra = measured_spectra(runs, geometry, means=candidate.effect.needs_mean)
        row = _score(item, candidate, spectra, geometry)
        if campaign % (CHUNKS * REPETITIONS // DIAGNOSES) == 0:
            row["diagnosed"] = _is_diagnosed(item, measured_spectra(runs, geometry, means=True), geometry)
        yield {"effect": item.label, "campaign": campaign, "size": size.value, **row}


def _add_noise(run: Run, geometry: Geometry, rng: np.random.Generator) -> Run:
    """The run with the noise of a simulated one."""
    noise = Noise()
    channels, loads = run.source.channels, run.source.loads  # type: ignore[attr-defined]
    sigma = np.array([noise.sigma_of_channel(channel) for channel in geometry.channels])
    noisy = noise.quantize(channels + sigma * rng.standard_normal(channels.shape))
    applied = np.any(loads != 0, axis=0)
    read = loads + np.where(applied, noise.load * rng.standard_normal(loads.shape), 0.0)
    return replace(run, source=MemorySource(noise.to_file_precision(noisy), noise.to_file_precision(read)))


def _score(item: PlannedClass, candidate: Candidate, spectra: Spectra, geometry: Geometry) -> dict[str, object]:
    """Gain of the effect, whether it is found, and sigma of parameters over the predicted one."""
    model = balance_model(geometry)
    batches = stack_runs(spectra.lines, spectra.statics, geometry.channel_names)
    minimum = fit_maximum_likelihood(model, batches, model.parameters.value)
    score = scores(model.at(minimum.theta), batches, [candidate], DEFAULT_SETTINGS.score)[0]
    count = forecast().base.model.candidate_count
    p_value = bonferroni_p_value(score.gain, score.parameters, count, score.noise_dof)
    found = p_value < DEFAULT_SETTINGS.selection.significance_level
    return {"gain": score.gain, "found": found, **_sigma_ratios(geometry, minimum.total.information)}


def _sigma_ratios(geometry: Geometry, information: np.ndarray) -> dict[str, float]:
    """Sigma of each parameter that the data inform, over the predicted one."""
    parameters = balance_model(geometry).parameters
    names = np.array(parameters.names)[parameters.free]
    sigma = np.sqrt(np.diag(covariance_from_information(information)))
    predicted = forecast().sigma
    return {
        f"sigma {name}": float(value / predicted[name])
        for name, value, prior in zip(names.tolist(), sigma, parameters.sigma[parameters.free], strict=True)
        if predicted[name] < LEAST_INFORMED * prior
    }


def _is_diagnosed(item: PlannedClass, spectra: Spectra, geometry: Geometry) -> bool:
    """Whether a whole diagnosis names the effect at its place, itself or as one that it cannot tell apart."""
    diagnosis, _ = diagnose(identify(spectra, geometry), spectra)
    named = [name for finding in diagnosis.effects for name in (finding.label, *finding.indistinguishable_from)]
    return item.label in named or item.effect in [name.partition("@")[0] for name in named]


def planning_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Detection rate of each class with its 95 % interval, and the median ratio of sigma over all parameters."""
    return pd.DataFrame([_table_row(effect, part) for effect, part in rows.groupby("effect", sort=False)])


def _table_row(effect: object, part: pd.DataFrame) -> dict[str, object]:
    found, campaigns = int(part["found"].sum()), len(part)
    interval = stats.binomtest(found, campaigns).proportion_ci(method="exact")
    sigma: Sequence[str] = [name for name in part if str(name).startswith("sigma ")]
    ratios = part[sigma].dropna(axis=1, how="all").median()
    return {
        "rig": RIG,
        "effect": effect,
        "size": part["size"].iloc[0],
        "campaigns": campaigns,
        "predicted": DetectionLevel().power,
        "found": found / campaigns,
        "lower": interval.low,
        "upper": interval.high,
        "p_value": stats.binomtest(found, campaigns, DetectionLevel().power).pvalue,
        "mean_gain": part["gain"].mean(),
        "diagnoses": int(part["diagnosed"].notna().sum()),
        "diagnosed": int(part["diagnosed"].fillna(False).sum()),
        "sigma_ratio_median": float(ratios.median()),
        "sigma_ratio_least": float(ratios.min()),
        "sigma_ratio_largest": float(ratios.max()),
    }
