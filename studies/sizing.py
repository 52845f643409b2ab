"""How large an effect must be to gain so much in chi-square, and what the truth of one campaign should have gained.

The score test's information about a candidate's own parameters, tolerances projected out, is V; a change d of them is
expected to gain d'V d. Sizes are found with the V of the rig that is drawn, on the lines of one campaign of the
declared one for each excitation; what a campaign should have gained follows from its own V at its own truth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ive
from scipy.stats import chi2, ncx2

from balance_cli.campaign.rig.geometry import DeclaredEffect, Geometry
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.diagnosis.choices import SIGNIFICANCE_LEVEL
from balance_cli.diagnosis.search.candidates import Candidate, candidate_at, parameters_of_interest
from balance_cli.diagnosis.search.score_statistics import scores
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.measured_spectra import Spectra, measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from balance_cli.model.effects import EFFECTS, EffectParameter
from balance_cli.simulation import TrueRig, simulate_campaign, true_rig
from studies.cases import SWEEPS, plan
from tests.support.truth import true_parameters

Array = NDArray[np.float64]

# Scatter of what only shapes an effect about where the library begins to look for it.
SHAPE = 0.2
MAINS_SCATTER = 0.02


@dataclass(frozen=True)
class HiddenEffect:
    """What is hidden: the effect, its fitted values by name, and the gain that was asked of it."""

    candidate: Candidate
    values: Mapping[str, float]
    target_gain: float

    @property
    def label(self) -> str:
        """NAME@PLACE."""
        return self.candidate.label

    @property
    def declared(self) -> DeclaredEffect:
        """As the simulation takes it."""
        return simulation_effect(self.candidate.at_start(self.values))

    @property
    def tested_parameters(self) -> tuple[EffectParameter, ...]:
        """The parameters that do something by themselves."""
        return parameters_of_interest(self.candidate.placed_effect.parameters)

    @property
    def departure(self) -> Array:
        """Their distance from their nulls (q,)."""
        return np.array([self.values[item.fitted_name] - item.fitted_null for item in self.tested_parameters])


def hidden_effect(
    label: str, size: float, excitation: str, geometry_file: str, rig: TrueRig, rng: np.random.Generator
) -> HiddenEffect:
    """The effect in the size that should gain so much, its signs and what shapes it drawn."""
    geometry = rig.geometry
    candidate = parse_candidate(label, geometry)
    values = {item.fitted_name: _draw_value(item, rng) for item in candidate.placed_effect.parameters}
    d = np.array(
        [
            values[item.fitted_name] - item.fitted_null
            for item in parameters_of_interest(candidate.placed_effect.parameters)
        ]
    )
    # What a tone's power shows rests on what is left of the lines: there it must be the rig that made them.
    whose = true_rig(geometry) if candidate.effect.name == "mains-pickup" else rig
    theta = true_parameters(whose, balance_model(geometry).parameters)
    batches = _simulate_declared_campaign(geometry_file, excitation)
    V = _information(geometry, theta, batches, Candidate(candidate.placed_effect, (values,)))
    share = scale_for_gain(size, _expected_gain(candidate, d, V))
    for item, departure in zip(parameters_of_interest(candidate.placed_effect.parameters), d, strict=True):
        values[item.fitted_name] = item.fitted_null + share * departure
    return HiddenEffect(candidate, values, size)


def _draw_value(item: EffectParameter, rng: np.random.Generator) -> float:
    """A change by the scale, its sign drawn where it has one; of what only shapes the effect a value near the start."""
    if not item.nuisance:
        sign = 1.0 if item.fitted_bounds[0] >= item.fitted_null else float(rng.choice([-1.0, 1.0]))
        return item.fitted_null + sign * item.fitted_scale * float(np.exp(SHAPE * rng.standard_normal()))
    z = float(rng.standard_normal())
    if item.unit == "Hz":
        return item.fitted_start + MAINS_SCATTER * z
    if item.fitted_bounds[0] >= 0.0:
        return item.fitted_start * float(np.exp(SHAPE * z))
    return item.fitted_start + item.fitted_scale * z


def simulation_effect(declared: DeclaredEffect) -> DeclaredEffect:
    """The effect with the word of its place as the parameter that it is."""
    choice = next(effect.choice for effect in EFFECTS if effect.name == declared.name)
    if choice is None:
        return declared
    *where, word = declared.where
    return declared.model_copy(update={"where": tuple(where), "parameters": {**declared.parameters, choice.name: word}})


def parse_candidate(label: str, geometry: Geometry) -> Candidate:
    """The candidate NAME@PLACE,PLACE."""
    name, _, where = label.partition("@")
    return candidate_at(name, tuple(part for part in where.split(",") if part), geometry)


@lru_cache(maxsize=4)
def _simulate_declared_campaign(geometry_file: str, excitation: str) -> tuple[Batch, ...]:
    """Batches of a campaign of the rig as declared."""
    geometry = load_geometry(geometry_file)
    runs, _ = simulate_campaign(true_rig(geometry), plan(excitation), seed=1)
    spectra = measured_spectra(runs, geometry, means=True)
    return stack_runs(spectra.lines, spectra.statics, geometry.channel_names)


def _information(geometry: Geometry, theta: Array, batches: Sequence[Batch], candidate: Candidate) -> Array:
    return scores(balance_model(geometry).at(theta), batches, [candidate], DEFAULT_SETTINGS.score)[0].information


def expected_gains(rig: TrueRig, spectra: Spectra, hidden: Sequence[HiddenEffect]) -> list[float]:
    """d'V d of each in this campaign, at the truth of the rig without them."""
    if not hidden:
        return []
    geometry = rig.geometry
    theta = true_parameters(rig, balance_model(geometry).parameters)
    batches = stack_runs(spectra.lines, spectra.statics, geometry.channel_names)
    found = []
    for one in hidden:
        V = _information(geometry, theta, batches, Candidate(one.candidate.placed_effect, (one.values,)))
        step = _expected_gain(one.candidate, one.departure, V)
        # At parameters without the tone its power is in what is left, and V says nothing.
        found.append(one.target_gain if step.tones else step.quadratic)
    return found


@dataclass(frozen=True)
class ExpectedGain:
    """d'V d of a step, and the number of runs that hear a tone of unknown phase; zero where it is none."""

    quadratic: float
    tones: int = 0


def _expected_gain(candidate: Candidate, d: Array, V: Array) -> ExpectedGain:
    tone = any(item.squared for item in parameters_of_interest(candidate.placed_effect.parameters))
    return ExpectedGain(float(d @ V @ d), SWEEPS if tone else 0)


def _tone_gain(step: ExpectedGain) -> float:
    """Expected gain; of a tone that of Rice's likelihood in runs that hear it alike.

    With l = a^2 n in each run, V d^2 is the sum of l^2, and 2 ln I0(a |b|) - l is gained at E |b|^2 = a^2 n^2 + 2 n.
    """
    if not step.tones:
        return step.quadratic
    of_run = np.sqrt(step.quadratic / step.tones)
    x = np.sqrt(of_run**2 + 2.0 * of_run)
    return float(step.tones * (2.0 * (np.log(ive(0, x)) + x) - of_run))


def scale_for_gain(size: float, step: ExpectedGain) -> float:
    """By how much the step must be multiplied to be expected to gain `size`."""
    if not step.tones:
        return float(np.sqrt(size / max(step.quadratic, 1e-300)))
    # A power grows with the share, and V d^2 with its square.
    power = brentq(lambda q: _tone_gain(replace(step, quadratic=q)) - size, 1e-3, max(1e10, size**2))
    return float(np.sqrt(power / step.quadratic))


def power(gain: float, parameters: int, candidates: int) -> float:
    """Probability that an effect of this expected gain is significant beside so many candidates: no test has more."""
    level = chi2.isf(SIGNIFICANCE_LEVEL / candidates, parameters)
    return float(ncx2.sf(level, parameters, gain))
