"""Where the maximum likelihood iteration begins: from least squares or from the geometry, whichever fits better."""

from __future__ import annotations

import numpy as np

from balance_cli.estimation.paper.equations import (
    Coefficients,
    free_coefficients,
    from_table,
    is_stable,
    stabilised,
)
from balance_cli.estimation.paper.likelihood import inverse, output_error_fit
from balance_cli.estimation.paper.output_error import GroupedLines, gauss_newton, point

REWEIGHTINGS = 8
SHARES = (0.8, 0.6, 0.4, 0.2, 0.0)
"""Shares of the off-diagonal damping that are left, step by step, on the way from full to diagonal damping."""
ITERATIONS_PER_SHARE = 12


def best_start(data: GroupedLines, starts: dict[str, Coefficients], full_damping: bool) -> tuple[Coefficients, str]:
    """A stable model near the minimum, and the name of the start that it came from; one of them is `geometry`.

    All have full damping. Each is refined by reweighted equation errors and judged by sum |eps|^2. For diagonal
    damping the off-diagonal part is then taken out step by step, the rest refitted at each: put to zero at once it may
    leave a mode unstable, and the minimum found from there lacks that mode.
    """
    refined = [(reweighted(data, model), name) for name, model in starts.items()]
    # The declared plate with equal damping everywhere is stable whatever the data are.
    safe = (_equal_damping(starts["geometry"]), "geometry")
    stable = [(model, name) for model, name in refined if model is not None]
    ranked = sorted([*stable, safe], key=lambda found: point(data, found[0], "equal").cost)
    if full_damping:
        return ranked[0]
    for model, name in ranked:
        diagonal = diagonalised(data, model)
        if diagonal is not None:
            return diagonal, name
    return safe


def reweighted(data: GroupedLines, start: Coefficients) -> Coefficients | None:
    """Least squares on the equation error weighted by the last model's compliance, repeated.

    R e is the output error where R is that of the model sought, so the weighting undoes most of the bias and of the
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
        at = point(data, model, "equal")
        if at.cost < least and is_stable(model):
            best, least = model, at.cost
        step = gauss_newton(data, free, at, regress_on="measured")
        table = model.table
        table[free] += inverse(step.hessian) @ step.gradient
        model = from_table(table)
    if best is None and model is not None:
        best = stabilised(model, full_damping=True)
    return best


def diagonalised(data: GroupedLines, start: Coefficients) -> Coefficients | None:
    """The model with diagonal damping that a full one turns into; None where it becomes unstable on the way."""
    n, m = start.B_F.shape
    free = free_coefficients(n, m, full_damping=False)
    off_diagonal = start.D - np.diag(np.diag(start.D))
    model = start
    for share in SHARES:
        model = Coefficients(np.diag(np.diag(model.D)) + share * off_diagonal, model.K, model.B_F)
        if not is_stable(model):
            return None
        model = output_error_fit(data, free, model, "equal", ITERATIONS_PER_SHARE).model
    return model


def _equal_damping(declared: Coefficients) -> Coefficients:
    n = len(declared.K)
    return Coefficients(np.eye(n) * np.trace(declared.D) / n, declared.K, declared.B_F)
