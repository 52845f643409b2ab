"""Simulated campaigns with something hidden, or nothing: does the loop say what it is, and does it help?

The truth comes from the integration in time. Every rig is drawn from the tolerances; an effect is sized by the gain in
chi-square that it should bring, tolerances projected out (`studies/sizing.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.diagnosis.result import PARTLY_EXPLAINED, UNEXPLAINED, Diagnosis, FoundEffect
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.simulation import TrueRig, draw_rig, simulate_campaign
from balance_cli.simulation.rig import apply_effects
from balance_cli.steps.diagnose import diagnose
from balance_cli.steps.hold_out import hold_out_errors
from balance_cli.steps.identify import identify
from studies.cases import Case, plan
from studies.coverage import Z_95
from studies.recovery import MIN_DAMPING_RATIO
from studies.sizing import HiddenEffect, expected_gains, hidden_effect, parse_candidate, power, simulation_effect
from studies.unknown import unknown_effect

GEOMETRY = str(Path(__file__).parents[1] / "configs" / "rts-6.yaml")
# What an effect that cannot show has: large enough to matter if it could.
UNTESTABLE_SCALES = 20.0
EFFECT_OF_UNKNOWN = {"saturating-channel": "saturation"}
"""The effect that describes what the study simulates by itself, where the library has one."""


def attribution_chunk(one: Case) -> pd.DataFrame:
    """What the loop makes of one campaign: one row."""
    geometry = _geometry(one)
    rig = _rig(geometry, one)
    hidden = _hidden_effects(one, rig)
    runs, _ = simulate_campaign(_add_hidden_effects(rig, one, hidden), _plan(one), seed=_noise_seed(one))
    spectra = measured_spectra(runs, geometry, means=True)
    before = identify(spectra, geometry)
    diagnosis, after = diagnose(before, spectra)
    errors = hold_out_errors(next(run for run in runs if run.kind == "check"), before, after)
    gains = expected_gains(rig, spectra, hidden)
    powers = [
        power(gain, len(item.tested_parameters), diagnosis.candidate_count)
        for gain, item in zip(gains, hidden, strict=True)
    ]
    row = {
        "kind": one.kind,
        "seed": one.seed,
        "hidden": " + ".join(one.hidden) or "nothing",
        "excitation": one.excitation,
        "expected_gain": min(gains, default=float("nan")),
        "possible": float(np.prod(powers)) if powers else float("nan"),
        "verdict": diagnosis.verdict,
        "found": " + ".join(effect.label for effect in diagnosis.effects),
        "gain": " + ".join(f"{effect.evidence.gain:.4g}" for effect in diagnosis.effects),
        "alike": " | ".join(", ".join(effect.indistinguishable_from) for effect in diagnosis.effects),
        "detected": bool(diagnosis.effects),
        "right": is_right(diagnosis, one),
        "by_set": any(not _is_named(effect, one.hidden) for effect in diagnosis.effects),
        "set_size": np.mean([1 + len(effect.indistinguishable_from) for effect in diagnosis.effects] or [np.nan]),
        "deviations": " ".join(f"{z:.3f}" for z in deviations(after, diagnosis.effects, hidden)),
        "not_testable": ", ".join(item.name for item in diagnosis.untestable_effects),
        "chi2_before": diagnosis.chi2_per_dof_before,
        "chi2_after": diagnosis.chi2_per_dof_after,
    }
    for name, side in (("before", errors.before), ("after", errors.after), ("noise", errors.noise)):
        row[f"load_error_{name}"] = max(side.load_error.values())
    return pd.DataFrame([row])


def _geometry(one: Case) -> Geometry:
    """The geometry of the case: where an offset is to have no channel that hears it, the piezo channels alone."""
    geometry = load_geometry(GEOMETRY)
    if one.hidden != ("load-offset@Fz",) or one.kind != "untestable":
        return geometry
    channels = tuple(channel for channel in geometry.channels if not channel.measures_dc)
    return geometry.model_copy(update={"channels": channels, "torque_meter": None})


def _plan(one: Case):  # type: ignore[no-untyped-def]
    deaf = one.kind == "untestable" and one.hidden == ("load-offset@Fz",)
    return plan(one.excitation, static=not deaf)


def _noise_seed(one: Case) -> int:
    return int(one.rng.integers(2**31))


def _rig(geometry: Geometry, one: Case) -> TrueRig:
    """Drawn from the tolerances, no mode less damped than the campaign shows."""
    rig = draw_rig(geometry, np.random.default_rng([_noise_seed(one), 1]))
    return replace(
        rig,
        damping_ratios=np.maximum(rig.damping_ratios, MIN_DAMPING_RATIO),
        torque_damping_ratio=np.maximum(rig.torque_damping_ratio, MIN_DAMPING_RATIO),
    )


def _hidden_effects(one: Case, rig: TrueRig) -> list[HiddenEffect]:
    """The effects of the library that are hidden with a size."""
    rng = np.random.default_rng([_noise_seed(one), 2])
    return [
        hidden_effect(label, size, one.excitation, GEOMETRY, rig, rng)
        for label, size in zip(one.hidden, one.sizes, strict=False)
    ]


def _add_hidden_effects(rig: TrueRig, one: Case, hidden: Sequence[HiddenEffect]) -> TrueRig:
    """The rig with all that is hidden in it."""
    if one.kind == "unknown":
        rng = np.random.default_rng([_noise_seed(one), 2])
        return rig.with_extensions(unknown_effect(one.hidden[0], rig.geometry.channel_names, rng))
    if one.kind == "untestable":
        candidate = parse_candidate(one.hidden[0], load_geometry(GEOMETRY))
        large = {
            item.fitted_name: item.fitted_null + UNTESTABLE_SCALES * item.fitted_scale
            for item in candidate.placed_effect.parameters
        }
        return apply_effects(rig, [simulation_effect(candidate.at_start(large))])
    return apply_effects(rig, [item.declared for item in hidden])


def is_right(diagnosis: Diagnosis, one: Case) -> bool:
    """What is hidden was found and nothing else, or, where it cannot be, nothing was said to be it.

    What no effect describes must leave the verdict open, unless the effect that does is found alone; of what cannot
    show it must be said so.
    """
    if one.kind == "unknown":
        name = EFFECT_OF_UNKNOWN.get(one.hidden[0])
        if name is not None and {effect.name for effect in diagnosis.effects} == {name}:
            return True
        physical = [effect for effect in diagnosis.effects if not effect.evidence.empirical]
        return not physical and diagnosis.verdict in (UNEXPLAINED, PARTLY_EXPLAINED)
    if one.kind == "untestable":
        untestable = {item.name for item in diagnosis.untestable_effects}
        return not diagnosis.effects and (one.hidden[0].partition("@")[0] in untestable or _is_testable_elsewhere(one))
    return is_attributed(diagnosis.effects, one.hidden)


def _is_testable_elsewhere(one: Case) -> bool:
    """Whether an effect can show at other places of the rig, though not where it is hidden."""
    return one.hidden[0].startswith("channel-offset")


def is_attributed(effects: Sequence[FoundEffect], hidden: Sequence[str]) -> bool:
    """Nothing else was found than what is hidden, each by name and place or within a declared set."""
    left = list(hidden)
    for effect in effects:
        names = (effect.label, *effect.indistinguishable_from)
        match = next((label for label in left if any(matches_effect(name, label) for name in names)), None)
        if match is None:
            return False
        left.remove(match)
    return not left


def _is_named(effect: FoundEffect, hidden: Sequence[str]) -> bool:
    return any(matches_effect(effect.label, label) for label in hidden)


def matches_effect(found: str, hidden: str) -> bool:
    """The same effect; at a part of its place where the rest of it is too stiff to be seen."""
    name, _, where = found.partition("@")
    other, _, there = hidden.partition("@")
    return name == other and set(where.split(",")) <= set(there.split(","))


def deviations(after: IdentifiedModel, effects: Sequence[FoundEffect], hidden: Sequence[HiddenEffect]) -> list[float]:
    """(estimate - truth) / sigma of the parameters that act by themselves, of each effect found by its own name.

    Where an interval of 95 % is given, sigma is the distance of its end, on the side of the truth, over 1.96.
    """
    table = after.parameters
    known = {name: i for i, name in enumerate(table.names)}
    found = []
    for item in hidden:
        effect = next((effect for effect in effects if matches_effect(effect.label, item.label)), None)
        bounds = {} if effect is None else {one.name: one.interval for one in effect.parameters if one.interval}
        for parameter in item.tested_parameters if effect else ():
            i = known.get(f"{effect.label}.{parameter.fitted_name}")  # type: ignore[union-attr]
            if i is not None and 0.0 < table.sigma[i] < np.inf:
                error, sigma = float(table.value[i] - item.values[parameter.fitted_name]), float(table.sigma[i])
                if parameter.name in bounds:
                    lower, upper = bounds[parameter.name]
                    sigma = (table.value[i] - lower if error > 0.0 else upper - table.value[i]) / Z_95
                found.append(float(error / max(sigma, 1e-300)))
    return found
