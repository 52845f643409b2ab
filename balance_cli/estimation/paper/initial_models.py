"""Initial models of the maximum-likelihood iteration: least squares or the geometry, whichever fits better."""

from __future__ import annotations

import numpy as np

from balance_cli.estimation.paper.equations import (
    Coefficients,
    coefficients_from_table,
    free_coefficients,
    is_stable,
    stabilize,
)
from balance_cli.estimation.paper.likelihood import fit_output_error, invert_scaled
from balance_cli.estimation.paper.output_error import GroupedLines, evaluate_model, gauss_newton_derivatives

REWEIGHTINGS = 8
"""Iterations of the reweighted equation error; from a mode that is 9 Hz off it takes three."""
OFF_DIAGONAL_FACTORS = (0.8, 0.6, 0.4, 0.2, 0.0)
"""Factors of the off-diagonal damping in the steps from full to diagonal damping."""
ITERATIONS_PER_FACTOR = 12
"""Iterations at each factor: enough to follow the minimum, which need not be reached before the last."""


def select_initial_model(
    data: GroupedLines, starts: dict[str, Coefficients], full_damping: bool
) -> tuple[Coefficients, str]:
    """Select a stable model near the minimum, and the name of its start; one of the starts is `geometry`.

    All have full damping. Each is refined by reweighted equation errors and judged by sum |eps|^2. For diagonal
    damping the off-diagonal part is then reduced step by step, and the rest refitted at each step: if it were set to
    zero at once, a mode might become unstable, and the minimum found from there would lack that mode.
    """
    refined = [(fit_reweighted_equation_error(data, model), name) for name, model in starts.items()]
    # The declared plate with equal damping is stable whatever the data are.
    fallback = (_equal_damping(starts["geometry"]), "geometry")
    stable = [(model, name) for model, name in refined if model is not None]
    ranked = sorted([*stable, fallback], key=lambda candidate: evaluate_model(data, candidate[0], "equal").cost)
    if full_damping:
        return ranked[0]
    for model, name in ranked:
        diagonal = continue_to_diagonal_damping(data, model)
        if diagonal is not None:
            return diagonal, name
    return fallback


def fit_reweighted_equation_error(data: GroupedLines, start: Coefficients) -> Coefficients | None:
    """Least squares on the equation error weighted by the last model's compliance, repeated.

    R e is the output error if R is that of the solution, so that the weighting removes most of the bias and of the
    emphasis on high frequencies (Sanathanan and Koerner, IEEE Trans. Automatic Control 8, 1963). Returns the stable
    iterate with the least sum |eps|^2, None where none is stable.
    """
    n, m = start.B_F.shape
    free = free_coefficients(n, m, full_damping=True)
    best, least = None, np.inf
    model: Coefficients | None = start
    for _ in range(REWEIGHTINGS):
        if model is None or not np.all(np.isfinite(model.table)):
            break
        at = evaluate_model(data, model, "equal")
        if at.cost < least and is_stable(model):
            best, least = model, at.cost
        step = gauss_newton_derivatives(data, free, at, regress_on="measured")
        table = model.table
        table[free] += invert_scaled(step.hessian) @ step.gradient
        model = coefficients_from_table(table)
    if best is None and model is not None:
        best = stabilize(model)
    return best


def continue_to_diagonal_damping(data: GroupedLines, start: Coefficients) -> Coefficients | None:
    """The model with diagonal damping reached from one with full damping; None where it becomes unstable."""
    n, m = start.B_F.shape
    free = free_coefficients(n, m, full_damping=False)
    off_diagonal = start.D - np.diag(np.diag(start.D))
    model = start
    for factor in OFF_DIAGONAL_FACTORS:
        model = Coefficients(np.diag(np.diag(model.D)) + factor * off_diagonal, model.K, model.B_F)
        if not is_stable(model):
            return None
        model = fit_output_error(data, free, model, "equal", ITERATIONS_PER_FACTOR).model
    return model


def _equal_damping(declared: Coefficients) -> Coefficients:
    n = len(declared.K)
    return Coefficients(np.eye(n) * np.trace(declared.D) / n, declared.K, declared.B_F)
