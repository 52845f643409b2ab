"""Simulated campaigns with something hidden, or nothing: does the loop say what it is, and does it help?

The truth comes from the integration in time. Every rig is drawn from the tolerances; an effect is sized by the gain in
chi-square that it should bring, tolerances projected out (the score test's information at the null).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from balance_cli.diagnose import diagnose
from balance_cli.diagnosed import Diagnosis
from balance_cli.diagnosis.candidates import Candidate, candidate_at, tested
from balance_cli.diagnosis.score import scores
from balance_cli.estimation.measurements import stacked
from balance_cli.geometry import DeclaredEffect, Geometry
from balance_cli.hold_out import hold_out_errors
from balance_cli.identified import IdentifiedModel
from balance_cli.identify import identify
from balance_cli.model.balance import balance_model
from balance_cli.simulation import (
    CampaignPlan,
    RotorPlan,
    SweepPlan,
    TrueRig,
    draw_rig,
    simulate_campaign,
)
from balance_cli.simulation.extensions import apply_effects
from balance_cli.simulation.plans import HIGH, blade_loads, statics
from balance_cli.spectra import Spectra, measured_spectra
from studies.recovery import LEAST_DAMPING

EXCITATIONS = ("multisine", "random", "stepped")
SIZES = (25.0, 1e4)
"""Expected gains in chi-square between which sizes are drawn, evenly in their logarithm."""
NOTHING = "nothing"

SINGLE: dict[str, tuple[tuple[str, ...], ...]] = {
    "support-flexibility": (("x", "y", "z", "psi", "theta", "phi"),),
    "mast-bending": (("x", "y"),),
    "parallel-stiffness": ((),),
    "cell-misalignment": (("z1",), ("y1",), ("x",)),
    "transverse-stiffness": (("all",), ("z2",)),
    "structural-damping": (("all",), ("y1",)),
    "cubic-stiffness": (("x", "inside"), ("z3", "beside")),
    "quadratic-stiffness": (("x", "inside"), ("y2", "beside")),
    "dry-friction": (("x",), ("z1",)),
    "channel-gain": (("x.strain",), ("z4.piezo",)),
    "low-pass": (("y1.strain",), ("z2.piezo",)),
    "high-pass": (("x.piezo",),),
    "time-delay": (("x.piezo",), ("z1.strain",)),
    "crosstalk": (("x.strain", "z1.strain"), ("y1.piezo", "z3.piezo")),
    "exciter-misalignment": (("Fx", "Fz"), ("My", "Fx")),
    "channel-offset": (("x.strain",),),
    "load-offset": (("Fz",),),
}
"""Effects that a campaign at rest with all six sweeps and static runs can show, at some of their places."""


@dataclass(frozen=True)
class Case:
    """One campaign: its seed, what is hidden in it, with which excitation, and the gain that is expected of it."""

    seed: int
    label: str
    excitation: str
    size: float


def case(seed: int, names: tuple[str, ...] = tuple(SINGLE)) -> Case:
    """Effects, places and excitations in turn, the size drawn."""
    rng = np.random.default_rng([seed, 11])
    name = names[seed % len(names)]
    turn = seed // len(names)
    where = SINGLE[name][turn % len(SINGLE[name])]
    size = float(np.exp(rng.uniform(*np.log(SIZES))))
    label = f"{name}@{','.join(where)}" if where else name
    return Case(seed, label, EXCITATIONS[turn % len(EXCITATIONS)], size)


def plan(excitation: str) -> CampaignPlan:
    """Two static runs, a sweep of each component, and a check run that is held out."""
    sweeps = tuple(
        SweepPlan(run=f"sweep-{name}", excited=(name,), level=(level,), excitation=excitation, period=2.0, periods=9)
        for name, level in HIGH.items()
    )
    check = RotorPlan(run="check-1", rotor_speed=17.5, duration=20.0, harmonics=blade_loads("Fx", "Fz", "My"))
    return CampaignPlan(runs=(*statics(), *sweeps, check))


def attribution_chunk(geometry: Geometry, one: Case) -> pd.DataFrame:
    """What the loop makes of one campaign: one row."""
    rng = np.random.default_rng([one.seed, 12])
    rig = draw_rig(geometry, rng)
    rig = replace(
        rig,
        damping_ratios=np.maximum(rig.damping_ratios, LEAST_DAMPING),
        torque_damping_ratio=max(rig.torque_damping_ratio, LEAST_DAMPING),
    )
    if one.label != NOTHING:
        rig = apply_effects(rig, [_hidden(geometry, rig, one, rng)])
    runs, _ = simulate_campaign(rig, plan(one.excitation), seed=one.seed)
    spectra = measured_spectra(runs, geometry, means=True)
    before = identify(spectra, geometry)
    diagnosis, after = diagnose(before, spectra)
    errors = hold_out_errors(next(run for run in runs if run.kind == "check"), before, after)
    found = [effect.label for effect in diagnosis.effects]
    return pd.DataFrame(
        [
            {
                "seed": one.seed,
                "hidden": one.label,
                "excitation": one.excitation,
                "expected_gain": one.size,
                "verdict": diagnosis.verdict,
                "found": " + ".join(found),
                "alike": " | ".join(name for effect in diagnosis.effects for name in effect.indistinguishable_from),
                "right": attributed(diagnosis, one.label),
                "set_size": 1 + max((len(effect.indistinguishable_from) for effect in diagnosis.effects), default=0),
                "chi2_before": diagnosis.chi2_per_dof_before,
                "chi2_after": diagnosis.chi2_per_dof_after,
                "load_error_before": max(errors.before.load_error.values()),
                "load_error_after": max(errors.after.load_error.values()),
                "load_error_noise": max(errors.noise.load_error.values()),
            }
        ]
    )


def attributed(diagnosis: Diagnosis, hidden: str) -> bool:
    """Nothing else was found than what is hidden, by name and place or within a declared set."""
    if hidden == NOTHING:
        return not diagnosis.effects
    if len(diagnosis.effects) != 1:
        return False
    effect = diagnosis.effects[0]
    return any(_same(label, hidden) for label in (effect.label, *effect.indistinguishable_from))


def _same(found: str, hidden: str) -> bool:
    """The same effect; at a part of its place where the rest of it is too stiff to be seen."""
    name, _, where = found.partition("@")
    other, _, there = hidden.partition("@")
    return name == other and set(where.split(",")) <= set(there.split(","))


def _hidden(geometry: Geometry, rig: TrueRig, one: Case, rng: np.random.Generator) -> DeclaredEffect:
    """The effect in the size that should gain `one.size`, its sign drawn where it has one."""
    name, _, where = one.label.partition("@")
    candidate = candidate_at(name, tuple(part for part in where.split(",") if part), geometry)
    share = np.sqrt(one.size / max(_gain_of_scale(geometry, rig, candidate, one), 1e-12))
    values = {}
    for item in candidate.one.parameters:
        value = item.fitted_start
        if item in tested(candidate.one.parameters):
            sign = 1.0 if item.fitted_bounds[0] >= item.fitted_null else rng.choice([-1.0, 1.0])
            value = item.fitted_null + sign * share * item.fitted_scale
        values[item.name] = float(item.natural(value))
    declared = candidate.at_start({})
    return declared.model_copy(update={"parameters": {**declared.parameters, **values}})


def _gain_of_scale(geometry: Geometry, rig: TrueRig, candidate: Candidate, one: Case) -> float:
    """Gain in chi-square of a change of every parameter by its scale, in this campaign of the rig without it."""
    runs, _ = simulate_campaign(rig, plan(one.excitation), seed=one.seed)
    spectra: Spectra = measured_spectra(runs, geometry, means=True)
    model: IdentifiedModel = identify(spectra, geometry)
    batches = stacked(spectra.lines, spectra.statics, geometry.channel_names)
    return scores(balance_model(geometry), model.parameters.value, batches, [candidate])[0].expected


def attribution_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Share of right attributions, sets and errors, by what was hidden."""
    rows = rows.assign(effect=rows["hidden"].str.partition("@")[0])
    grouped = rows.groupby("effect", sort=False)
    return pd.DataFrame(
        {
            "campaigns": grouped.size(),
            "right": grouped["right"].mean(),
            "mean_set_size": grouped["set_size"].mean(),
            "chi2_after_median": grouped["chi2_after"].median(),
            "load_error_before_median": grouped["load_error_before"].median(),
            "load_error_after_median": grouped["load_error_after"].median(),
            "load_error_noise_median": grouped["load_error_noise"].median(),
        }
    ).reset_index()
