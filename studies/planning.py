"""What `balance plan` predicts, against what simulated campaigns achieve: detection rate and sigma of parameters.

Each campaign has one effect of the smallest size that the plan says is found 90 % of the time. It is found where its
own score is significant at the level that a diagnosis of all candidates uses, before the refits and the comparison with
rivals of a whole diagnosis.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pandas as pd
from scipy import stats

from balance_cli.campaign.rig.geometry import DeclaredEffect, Geometry
from balance_cli.diagnosis.search.candidates import candidate_at
from balance_cli.diagnosis.search.score_statistics import scores
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.diagnosis.significance import bonferroni_p_value
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.identifiability import covariance_from_information
from balance_cli.estimation.maximum_likelihood import fit_maximum_likelihood
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from balance_cli.planning.candidate_runs import candidate_runs
from balance_cli.planning.detectability import DetectionLevel, SmallestSize, project, smallest_sizes
from balance_cli.planning.hall import Hall
from balance_cli.planning.information import add_information
from balance_cli.simulation import CampaignPlan, simulate_campaign, true_rig
from balance_cli.simulation.rig import apply_effects
from balance_cli.steps.plan import PlanningRig, planning_rig
from tests.support.other_rigs import other_rig, short_campaign

REHEARSALS = 5
LEAST_INFORMED = 0.5
"""Predicted sigma over the declared one, below which a parameter is informed by data, and its sigma compared."""


@dataclass(frozen=True)
class PlannedClass:
    """One effect on one rig: its label, the parameter that has a size, and the words that the effect needs."""

    rig: str
    effect: str
    where: tuple[str, ...]
    parameter: str
    choice: tuple[str, str] | None = None

    @property
    def label(self) -> str:
        """NAME@PLACE."""
        return f"{self.effect}@{','.join(self.where)}"


CLASSES = (
    PlannedClass("A", "structural-damping", ("l1",), "loss_factor"),
    PlannedClass("A", "crosstalk", ("l2.strain", "l1.strain"), "fraction"),
    PlannedClass("A", "cell-misalignment", ("l3",), "angle_1"),
    PlannedClass("A", "time-delay", ("l5.piezo",), "delay"),
    PlannedClass("D", "channel-gain", ("z1.piezo",), "gain"),
    PlannedClass("D", "cubic-stiffness", ("y1", "inside"), "k3", ("side", "inside")),
)
CAMPAIGNS_OF_RIG = {"A": 40, "D": 20}
"""Campaigns of each class: those of D take three to five times as long."""


@dataclass(frozen=True)
class Forecast:
    """A plan of one sweep of each component on one rig, and what it predicts."""

    base: PlanningRig
    plan: CampaignPlan
    sigma: dict[str, float]
    sizes: dict[tuple[str, str], SmallestSize]


@lru_cache
def forecast(rig: str) -> Forecast:
    """The plan of a rig and its forecast; the same for all campaigns."""
    geometry = other_rig(rig)
    base = planning_rig(geometry, _hall(rig))
    runs = candidate_runs(geometry, _hall(rig), base.settings, base.limits)
    information = [base.information(item.plan, range(1000, 1000 + REHEARSALS)) for item in runs]
    projected = project(add_information(information, base.model), base.model)
    names = np.array(base.model.model.parameters.names)[base.model.model.parameters.free][base.model.indices.fitted]
    sigma = dict(zip(names.tolist(), np.sqrt(np.diag(projected.covariance)).tolist(), strict=True))
    sizes = {(item.label, item.parameter): item for item in smallest_sizes(projected, base.model, DetectionLevel())}
    return Forecast(base, CampaignPlan(runs=tuple(item.plan for item in runs)), sigma, sizes)


def _hall(rig: str) -> Hall:
    sweeps = [run for run in short_campaign(rig).runs if run.kind == "sweep"]
    return Hall(
        format="balance-hall/1",
        exciters={run.excited[0]: {"rms": run.level[0]} for run in sweeps},
        band=sweeps[0].band,
        sample_rate=sweeps[0].sample_rate,
        period=None if rig == "D" else 1.0,
        periods=(5,),
        levels=(1.0,),
        phases="random",
        effects=tuple({item.effect for item in CLASSES if item.rig == rig}),
    )


def planning_chunk(seed: int) -> pd.DataFrame:
    """One campaign of each class: gain of the effect, whether it is found, and sigma over the predicted one."""
    rows = [_campaign(item, seed) for item in CLASSES if seed < CAMPAIGNS_OF_RIG[item.rig]]
    return pd.concat(rows, ignore_index=True)


def _campaign(item: PlannedClass, seed: int) -> pd.DataFrame:
    expected, geometry = forecast(item.rig), other_rig(item.rig)
    size = expected.sizes[item.label, item.parameter]
    candidate = candidate_at(item.effect, item.where, geometry)
    null = next(each.null for each in candidate.placed_effect.parameters if each.name == item.parameter)
    where = item.where if item.choice is None else item.where[:-1]
    values: dict[str, float | str] = {item.parameter: null + size.value, **dict([item.choice] if item.choice else [])}
    rig = apply_effects(true_rig(geometry), [DeclaredEffect(name=item.effect, where=where, parameters=values)])
    runs, _ = simulate_campaign(rig, expected.plan, seed=seed)
    spectra = measured_spectra(runs, geometry, means=candidate.effect.needs_mean)
    batches = stack_runs(spectra.lines, spectra.statics, geometry.channel_names)
    minimum = fit_maximum_likelihood(balance_model(geometry), batches, balance_model(geometry).parameters.value)
    score = scores(balance_model(geometry), minimum.theta, batches, [candidate], DEFAULT_SETTINGS.score)[0]
    count = expected.base.model.candidate_count
    p_value = bonferroni_p_value(score.gain, score.parameters, count, score.noise_dof)
    row = {"rig": item.rig, "effect": item.label, "seed": seed, "size": size.value, "gain": score.gain}
    found = p_value < DEFAULT_SETTINGS.selection.significance_level
    return pd.DataFrame([{**row, "found": found, **_sigma_ratios(geometry, batches, minimum.total.information, item)}])


def _sigma_ratios(
    geometry: Geometry, batches: tuple[Batch, ...], information: np.ndarray, item: PlannedClass
) -> dict[str, float]:
    """Sigma of each parameter that the data inform, over the predicted one."""
    parameters = balance_model(geometry).parameters
    names = np.array(parameters.names)[parameters.free]
    sigma = np.sqrt(np.diag(covariance_from_information(information)))
    declared = parameters.sigma[parameters.free]
    predicted = forecast(item.rig).sigma
    return {
        f"sigma {name}": float(value / predicted[name])
        for name, value, prior in zip(names.tolist(), sigma, declared, strict=True)
        if predicted[name] < LEAST_INFORMED * prior
    }


def planning_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Detection rate of each class with its 95 % interval, and the median ratio of sigma over all parameters."""
    table = []
    for (rig, effect), part in rows.groupby(["rig", "effect"], sort=False):
        found, campaigns = int(part["found"].sum()), len(part)
        interval = stats.binomtest(found, campaigns).proportion_ci(method="exact")
        ratios = part[[name for name in part if name.startswith("sigma ")]].dropna(axis=1, how="all").median()
        table.append(
            {
                "rig": rig,
                "effect": effect,
                "size": part["size"].iloc[0],
                "campaigns": campaigns,
                "predicted": DetectionLevel().power,
                "found": found / campaigns,
                "lower": interval.low,
                "upper": interval.high,
                "sigma_ratio_median": float(ratios.median()),
                "sigma_ratio_least": float(ratios.min()),
                "sigma_ratio_largest": float(ratios.max()),
            }
        )
    return pd.DataFrame(table)
