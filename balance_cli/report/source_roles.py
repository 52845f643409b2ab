"""Roles of models and loads on the page: how each is labeled, ordered and drawn."""

from __future__ import annotations

from enum import StrEnum

from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.reduction.choices import HARMONIC, HARMONICS
from balance_cli.reduction.response_description import ResponseDescription, ResponseKind, parse_response_text
from balance_cli.reduction.result import HubLoads
from balance_cli.report.figure_style import BLUE, GRAY, GREEN, ORANGE, PURPLE, SKY, VERMILION, PlotStyle


class SourceRole(StrEnum):
    """What a model is, or what loads were reduced with, in the order of comparison on the page."""

    STATIC = "static"
    MEASURED = "measured"
    COMPUTED = "computed"
    PAPER_LS = "paper-ls"
    PAPER = "paper"
    LS = "ls"
    IDENTIFIED = "identified"
    UPDATED = "updated"
    OTHER = "other"


ROLE_ORDER = tuple(SourceRole)
PREFERRED_MODELS = (
    SourceRole.UPDATED,
    SourceRole.IDENTIFIED,
    SourceRole.PAPER,
    SourceRole.LS,
    SourceRole.PAPER_LS,
)
"""Identified models, the best one first."""
PREFERRED_LOADS = (*PREFERRED_MODELS, SourceRole.MEASURED, SourceRole.COMPUTED, SourceRole.STATIC)
"""What loads were reduced with, the best one first."""
PLOT_STYLES = {
    SourceRole.STATIC: PlotStyle(GRAY, (1, 1), "s"),
    SourceRole.MEASURED: PlotStyle(ORANGE, (6, 1.5, 1, 1.5), "D"),
    SourceRole.COMPUTED: PlotStyle(VERMILION, (4, 1.5), "^"),
    SourceRole.PAPER_LS: PlotStyle("#7fc8b0", (2, 1), "P"),
    SourceRole.PAPER: PlotStyle(GREEN, (2, 1), "X"),
    SourceRole.LS: PlotStyle(SKY, (5, 1), "v"),
    SourceRole.IDENTIFIED: PlotStyle(BLUE, (), "o"),
    SourceRole.UPDATED: PlotStyle(PURPLE, (), "*"),
}
MAX_NAMED_EFFECTS = 2
"""Effects of a model that its label names; more would not fit the column of a table, and are counted."""
METHOD_LABELS = {"ls": "LS", "ml": "ML", "ls+ml": "LS+ML"}


def model_role(model: IdentifiedModel) -> tuple[SourceRole, str]:
    """Role and label of a model by its form, its method and its effects."""
    kind = ResponseKind.PAPER_FORM if model.form == "paper" else ResponseKind.PHYSICAL_MODEL
    effects = tuple(dict.fromkeys(effect.name for effect in model.geometry.effects))
    damping = "" if model.paper is None else model.paper.options.damping
    return _role_of_response(ResponseDescription(kind, model.method, damping, effects))


def loads_role(loads: HubLoads) -> tuple[SourceRole, str]:
    """Role and label of loads by the response that they were reduced with."""
    description = parse_response_text(loads.response)
    return (SourceRole.OTHER, loads.response) if description is None else _role_of_response(description)


def _role_of_response(description: ResponseDescription) -> tuple[SourceRole, str]:
    if description.kind is ResponseKind.STATIC:
        return SourceRole.STATIC, "static matrix"
    if description.kind is ResponseKind.MEASURED:
        return SourceRole.MEASURED, "measured response"
    if description.effects or description.method == "computed":
        return _role_with_effects(description)
    return _role_of_fit(description)


def _role_with_effects(description: ResponseDescription) -> tuple[SourceRole, str]:
    """Role and label of a computed model, and of a fitted one with effects; many effects are counted, not named."""
    effects = description.effects
    names = ", ".join(effects) if len(effects) <= MAX_NAMED_EFFECTS else f"{len(effects)} effects"
    if description.method == "computed":
        return SourceRole.COMPUTED, f"computed model with {names}" if effects else "computed model"
    return SourceRole.UPDATED, f"updated model ({names})"


def _role_of_fit(description: ResponseDescription) -> tuple[SourceRole, str]:
    """Role and label of a model without effects that was fitted."""
    least_squares = description.method == "ls"
    method = METHOD_LABELS.get(description.method, description.method)
    if description.kind is ResponseKind.PAPER_FORM:
        damping = ", full damping" if description.damping == "full" else ""
        label = f"paper\N{RIGHT SINGLE QUOTATION MARK}s form ({method}{damping})"
        return SourceRole.PAPER_LS if least_squares else SourceRole.PAPER, label
    return SourceRole.LS if least_squares else SourceRole.IDENTIFIED, f"rigid model ({method})"


def method_labels(loads: HubLoads) -> tuple[str, ...]:
    """What the label of loads adds to that of the response: the method, and a load model other than the default."""
    if loads.method == HARMONIC:
        return ()
    load_models = {run.in_time.load_model for run in loads.runs.values() if run.in_time is not None} - {HARMONICS}
    return (loads.method, *(f"{name} loads" for name in sorted(load_models)))
