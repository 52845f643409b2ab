"""Study of the static calibration: whether it selects the true terms, and how often its intervals contain check loads.

Balances of 8 channels (the last one responds to the torque) and 6 loads, each channel with up to four nonlinear terms
of any family. Loading as at a calibration stand: each load alone, up and down in both directions, then each load up and
down beside another constant load. Each load series has its own zero. The check run applies all loads at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.all_trims_result import CheckLoads
from balance_cli.calibration.check_loads import CheckModels, HeldOutRun, evaluate_check_loads
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.least_squares import solve_least_squares
from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.noise import CalibrationNoise
from balance_cli.calibration.terms import Term, all_terms, linear_terms, term_from_name, term_values
from balance_cli.campaign.rig.components import COMPONENTS

Array = NDArray[np.float64]

CHANNELS = ("g1", "g2", "g3", "g4", "g5", "g6", "g7", "torque")
FULL_RANGE = np.array([800.0, 800.0, 3500.0, 400.0, 400.0, 450.0])
TERMS = all_terms(len(COMPONENTS))
LOADS = len(COMPONENTS)
# Shares of a channel's range: noise of a reading, size of a nonlinear term, shift of the zero between load series.
NOISE = (3e-4, 5e-4)
SIZE = (4e-3, 2e-2)
SHIFT = 1e-2
MAX_NONLINEAR_TERMS = 4
# Response of a torque channel to the other loads; the largest condition that balances are built with.
CROSSTALK = 0.02
CONDITION = 10.0
CONSTANT_LOAD = 0.6
CHECKS = 200


@dataclass(frozen=True)
class TrueBalance:
    """Coefficients (96, 8) [V] of the terms, loads over their range; range (8,) of the channels and noise (8,) [V]."""

    coefficients: Array
    range: Array
    noise: Array

    def readings(self, x: Array, zero: Array, rng: np.random.Generator) -> Array:
        """Readings (m, 8) [V] at loads x (m, 6) in units of the calibrated range, with zeros (m, 8)."""
        return (
            term_values(TERMS, x) @ self.coefficients + zero + self.noise * rng.standard_normal((len(x), len(CHANNELS)))
        )

    def curved(self, channel: int) -> set[Term]:
        """The nonlinear terms of a channel."""
        return {TERMS[i] for i in np.flatnonzero(self.coefficients[:, channel]) if not TERMS[i].linear}


def stand_schedule() -> tuple[Array, NDArray[np.intp]]:
    """Loads (m, 6) in units of the calibrated range, and the load series (m,) of each row."""
    steps = np.arange(1, 6) / 5
    ramp = np.r_[steps, steps[-2::-1], 0.0]
    parts = [np.outer(np.r_[ramp, -ramp], np.eye(LOADS)[i]) for i in range(LOADS)]
    for moved, hangs in permutations(range(LOADS), 2):
        # Of each pair all four combinations of signs, two with either load hanging.
        for sign in (1.0, -1.0):
            other = sign if moved < hangs else -sign
            x = np.outer(np.r_[0.0, ramp], sign * np.eye(LOADS)[moved])
            parts.append(x + other * CONSTANT_LOAD * np.eye(LOADS)[hangs])
    return np.vstack(parts), np.repeat(np.arange(len(parts)), [len(part) for part in parts])


def draw_balance(rng: np.random.Generator) -> TrueBalance:
    """A balance by chance."""
    straight = _draw_linear_coefficients(rng)
    while np.linalg.cond(straight) > CONDITION:
        straight = _draw_linear_coefficients(rng)
    largest = np.max(np.abs(stand_schedule()[0] @ straight.T), axis=0)
    coefficients = np.zeros((len(TERMS), len(CHANNELS)))
    coefficients[:LOADS] = straight.T
    curved = [i for i, term in enumerate(TERMS) if not term.linear]
    for c, size in enumerate(largest):
        number = int(rng.integers(MAX_NONLINEAR_TERMS + 1))
        chosen = rng.choice(curved, number, replace=False)
        coefficients[chosen, c] = size * rng.choice([-1.0, 1.0], number) * rng.uniform(*SIZE, number)
    return TrueBalance(coefficients, largest, largest * rng.uniform(*NOISE, len(CHANNELS)))


def _draw_linear_coefficients(rng: np.random.Generator) -> Array:
    found = rng.standard_normal((len(CHANNELS), LOADS))
    found[-1] = CROSSTALK * found[-1] + np.eye(LOADS)[-1]
    return np.asarray(found)


def simulate_calibration(
    balance: TrueBalance, rng: np.random.Generator
) -> tuple[CalibrationPoints, tuple[str, Array, Array]]:
    """A calibration and a check run, which begins without load."""
    x, sequence = stand_schedule()
    shift = SHIFT * balance.range * rng.standard_normal((int(sequence[-1]) + 1, len(CHANNELS)))
    channels = balance.readings(x, shift[sequence], rng)
    run, weight = np.zeros(len(x), dtype=np.intp), np.ones(len(x))
    points = CalibrationPoints(CHANNELS, COMPONENTS, ("stand",), channels, x * FULL_RANGE, run, weight, FULL_RANGE)
    check = np.vstack([np.zeros(LOADS), rng.uniform(-1.0, 1.0, (CHECKS, LOADS))])
    zero = SHIFT * balance.range * rng.standard_normal(len(CHANNELS))
    return points, ("check", balance.readings(check, zero, rng), check * FULL_RANGE)


def calibration_chunk(seed: int) -> pd.DataFrame:
    """One balance: what was missed and what is spurious, and errors and intervals of the check loads, by component."""
    rng = np.random.default_rng([seed, 1991])
    balance = draw_balance(rng)
    points, run = simulate_calibration(balance, rng)
    whole = calibrate_all_trims(points, [HeldOutRun(*run)])
    (check,) = whole.checks
    floor = _check_true_model(balance, whole.model, run)
    true = [balance.curved(c) for c in range(len(CHANNELS))]
    found = [_nonlinear_terms_found(whole.model, name) for name in CHANNELS]
    rows = check.is_valid & floor.is_valid
    return pd.DataFrame(
        {
            "seed": seed,
            "component": COMPONENTS,
            "curved": sum(map(len, true)),
            "missed": _format_terms([one - other for one, other in zip(true, found, strict=True)]),
            "spurious": _format_terms([one - other for one, other in zip(found, true, strict=True)]),
            "undecidable": sum(
                _fits_better(points, c, found[c], true[c]) for c in range(len(CHANNELS)) if found[c] != true[c]
            ),
            "wrong_channels": sum(one != other for one, other in zip(found, true, strict=True)),
            "refused": len(whole.model.unsupported_terms),
            "set_aside": len(whole.outliers) + len(whole.suspect_series),
            "solved": check.is_valid.mean(),
            # The first row told the zero.
            "hits": np.mean(
                (np.abs(check.computed - check.applied) <= check.prediction_interval)[1:][check.is_valid[1:]], axis=0
            ),
            "rms": _rms(check, rows),
            "floor": _rms(floor, rows),
        }
    )


def _nonlinear_terms_found(model: CalibrationModel, channel: str) -> set[Term]:
    terms = (term_from_name(name, COMPONENTS) for name in model.channel_coefficients(channel))
    return {term for term in terms if not term.linear}


def _format_terms(terms: list[set[Term]]) -> str:
    """Terms by channel, in words."""
    named = zip(CHANNELS, terms, strict=True)
    return "; ".join(f"{channel}: {term.name(COMPONENTS)}" for channel, one in named for term in one) or "-"


def _fits_better(points: CalibrationPoints, channel: int, found: set[Term], true: set[Term]) -> bool:
    """Whether as many terms as the truth has, or fewer, leave less than the truth: then the readings mislead."""
    left = []
    for terms in (found, true):
        X = term_values((*linear_terms(LOADS), *terms), points.x)
        left.append(float(solve_least_squares(X, points.channels[:, [channel]], points.load_series).variance[0]))
    return len(found) <= len(true) and left[0] < left[1]


def _rms(check: CheckLoads, rows: NDArray[np.bool_]) -> Array:
    return np.asarray(np.sqrt(np.mean(((check.computed - check.applied)[rows] / FULL_RANGE) ** 2, axis=0)))


def _check_true_model(balance: TrueBalance, model: CalibrationModel, run: tuple[str, Array, Array]) -> CheckLoads:
    """What the true model and the true noise make of the same readings."""
    kept = [i for i, term in enumerate(TERMS) if term.linear or np.any(balance.coefficients[i])]
    noise = np.diag(balance.noise**2)
    truth = replace(
        model,
        terms=tuple(TERMS[i].name(COMPONENTS) for i in kept),
        coefficients=balance.coefficients[kept],
        covariance=np.zeros((len(CHANNELS), len(kept), len(kept))),
        residual_covariance=noise,
    )
    return evaluate_check_loads(CheckModels(truth, CalibrationNoise(noise, np.zeros(LOADS))), *run)[0]


def calibration_table(rows: pd.DataFrame) -> pd.DataFrame:
    """What is asked of the calibration, over all balances: quantity, component where it has one, value."""
    seeds = rows.drop_duplicates("seed")
    right = (seeds["missed"] == "-") & (seeds["spurious"] == "-")
    found: list[tuple[str, str, float]] = [
        ("balances", "all", len(seeds)),
        ("curved terms", "all", seeds["curved"].sum()),
        ("share with all true terms", "all", (seeds["missed"] == "-").mean()),
        ("share with nothing spurious", "all", (seeds["spurious"] == "-").mean()),
        ("share with neither", "all", right.mean()),
        ("terms missed", "all", _count(seeds["missed"])),
        ("terms spurious", "all", _count(seeds["spurious"])),
        ("channels with wrong terms", "all", seeds["wrong_channels"].sum()),
        ("of these, fitted better than by the truth", "all", seeds["undecidable"].sum()),
        ("rows or sequences set aside", "all", seeds["set_aside"].sum()),
        ("share of check loads solved", "all", seeds["solved"].mean()),
    ]
    for name, part in [*rows.groupby("component", sort=False), ("all", rows)]:
        error, floor = (float(np.sqrt(np.mean(part[key] ** 2))) for key in ("rms", "floor"))
        found += [("coverage of 95 % intervals", str(name), part["hits"].mean())]
        found += [("rms error, percent of full range", str(name), 100.0 * error)]
        found += [("rms error over noise floor", str(name), error / floor)]
    table = pd.DataFrame(found, columns=["quantity", "component", "value"])
    return table.sort_values("quantity", kind="stable", key=lambda name: name.map(_order(found)))


def _order(found: list[tuple[str, str, float]]) -> dict[str, int]:
    return {name: place for place, name in enumerate(dict.fromkeys(name for name, _, _ in found))}


def _count(listed: pd.Series) -> int:
    return int(sum(0 if one == "-" else one.count(";") + 1 for one in listed))
