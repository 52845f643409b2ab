"""What a page is made from: artefacts by kind, each with the label, the rank and the look it has on the whole page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.result import Diagnosis
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.io.artefacts import Artefact
from balance_cli.reduction.result import HubLoads
from balance_cli.report.figure_style import (
    BLUE,
    DATA_STYLE,
    EXTRA_COLORS,
    GRAY,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    PlotStyle,
)
from balance_cli.signals.response.transfer import Transfer

FORMATS: Mapping[str, type[Any]] = {
    "balance-calibration/1": Calibration,
    "balance-transfer/1": Transfer,
    "balance-model/1": IdentifiedModel,
    "balance-diagnosis/1": Diagnosis,
    "balance-loads/1": HubLoads,
}

T = TypeVar("T")

# In the order in which methods are compared: from what the paper started with to what it asks for.
RANKS = ("static", "measured", "computed", "paper-ls", "paper", "ls", "identified", "closed")
PLOT_STYLES = {
    "static": PlotStyle(GRAY, (1, 1), "s"),
    "measured": PlotStyle(ORANGE, (6, 1.5, 1, 1.5), "D"),
    "computed": PlotStyle(VERMILION, (4, 1.5), "^"),
    "paper-ls": PlotStyle("#7fc8b0", (2, 1), "P"),
    "paper": PlotStyle(GREEN, (2, 1), "X"),
    "ls": PlotStyle(SKY, (5, 1), "v"),
    "identified": PlotStyle(BLUE, (), "o"),
    "closed": PlotStyle(PURPLE, (), "*"),
}
MAX_NAMED_EFFECTS = 2
"""Effects of a model that its label names; more are counted."""
METHOD_LABELS = {"ls": "LS", "ml": "ML", "ls+ml": "LS+ML"}


@dataclass(frozen=True)
class Source(Generic[T]):
    """One artefact: its file name, its content, and how the page calls and draws it."""

    file: str
    artefact: Artefact
    content: T
    rank: str = ""
    label: str = ""
    plot_style: PlotStyle = DATA_STYLE


@dataclass(frozen=True)
class Sources:
    """All artefacts of a page, each kind in the order in which it is shown."""

    calibrations: tuple[Source[Calibration], ...] = ()
    transfers: tuple[Source[Transfer], ...] = ()
    models: tuple[Source[IdentifiedModel], ...] = ()
    diagnoses: tuple[Source[Diagnosis], ...] = ()
    loads: tuple[Source[HubLoads], ...] = ()

    @property
    def all_sources(self) -> tuple[Source[Any], ...]:
        """All of them, in the order of a campaign."""
        return (*self.calibrations, *self.transfers, *self.models, *self.diagnoses, *self.loads)

    @property
    def geometries(self) -> tuple[Geometry, ...]:
        """The different geometries that the artefacts were made from, the declared effects aside."""
        declared = [source.content.geometry for source in self.all_sources]
        different: list[Geometry] = []
        for geometry in declared:
            bare = geometry.model_copy(update={"effects": ()})
            if bare not in different:
                different.append(bare)
        return tuple(different)


def sources(artefacts: Sequence[tuple[Path, Artefact]]) -> Sources:
    """Sort artefacts by kind and give each its label; two with one label get their file names as well."""
    of: dict[str, list[Source[Any]]] = {format: [] for format in FORMATS}
    for path, artefact in artefacts:
        of[artefact.format].append(Source(path.name, artefact, artefact.content))
    models = _make_labels_unique([_label_model(source) for source in of["balance-model/1"]])
    by_digest = {source.artefact.digest: source for source in models}
    loads = _make_labels_unique([_label_loads(source, by_digest) for source in of["balance-loads/1"]])
    drawn_models, drawn_loads = _assign_plot_styles(models, loads)
    return Sources(
        calibrations=_label_sources(of["balance-calibration/1"], "calibration"),
        transfers=_label_sources(of["balance-transfer/1"], "measurement"),
        models=drawn_models,
        diagnoses=_label_sources(of["balance-diagnosis/1"], "diagnosis"),
        loads=drawn_loads,
    )


def _label_sources(found: list[Source[Any]], label: str) -> tuple[Source[Any], ...]:
    """The sources of a kind that has one label only."""
    return tuple(_make_labels_unique([replace(source, label=label) for source in found]))


def _make_labels_unique(named: list[Source[Any]]) -> list[Source[Any]]:
    """The same sources with labels that differ, in the order of their rank."""
    count = Counter(source.label for source in named)
    labelled = [
        replace(source, label=f"{source.label}, {Path(source.file).stem}") if count[source.label] > 1 else source
        for source in named
    ]
    again = Counter(source.label for source in labelled)
    seen: Counter[str] = Counter()
    distinct = []
    for source in labelled:
        seen[source.label] += 1
        several = again[source.label] > 1
        distinct.append(replace(source, label=f"{source.label} ({seen[source.label]})") if several else source)
    return sorted(distinct, key=lambda source: (_rank_index(source.rank), source.label))


def _rank_index(rank: str) -> int:
    return RANKS.index(rank) if rank in RANKS else len(RANKS)


def _label_model(source: Source[IdentifiedModel]) -> Source[IdentifiedModel]:
    rank, label = model_role(source.content)
    return replace(source, rank=rank, label=label)


def model_role(model: IdentifiedModel) -> tuple[str, str]:
    """Rank and label of a model by its form, its method and the effects in it."""
    effects = tuple(dict.fromkeys(effect.name for effect in model.geometry.effects))
    if effects or model.method == "computed":
        return _role_with_effects(model.method, effects)
    full = model.paper is not None and model.paper.options.damping == "full"
    return _role_of_fit(model.form, model.method, ", full damping" if full else "")


def _role_with_effects(method: str, effects: tuple[str, ...]) -> tuple[str, str]:
    """Rank and label of a computed model, and of a fitted one with effects; many effects are counted, not named."""
    named = ", ".join(effects) if len(effects) <= MAX_NAMED_EFFECTS else f"{len(effects)} effects"
    if method == "computed":
        return "computed", f"computed with {named}" if effects else "computed"
    return "closed", f"closed: {named}"


def _role_of_fit(form: str, method: str, more: str = "") -> tuple[str, str]:
    """Rank and label of a model without effects that was fitted by this method; `more` ends its label."""
    words = METHOD_LABELS.get(method, method) + more
    if form == "paper":
        return ("paper-ls" if method == "ls" else "paper"), f"paper\N{RIGHT SINGLE QUOTATION MARK}s form ({words})"
    return ("ls" if method == "ls" else "identified"), f"identified rigid ({words})"


def _label_loads(source: Source[HubLoads], models: Mapping[str, Source[IdentifiedModel]]) -> Source[HubLoads]:
    """Loads bear the label of the model that they were made with; without it that of their own description."""
    rank, label = _response_role(source.content.response)
    for item in source.artefact.provenance.inputs:
        if item.role == "model" and item.digest in models:
            rank, label = models[item.digest].rank, models[item.digest].label
    return replace(source, rank=rank, label=", ".join([label, *_method_labels(source.content)]))


def _method_labels(loads: HubLoads) -> tuple[str, ...]:
    """What a label adds to that of the response: the method, and what it knows of the loads where that is not usual."""
    if loads.method == "harmonic":
        return ()
    taken = {run.in_time.load_model for run in loads.runs.values() if run.in_time is not None} - {"harmonics"}
    return (loads.method, *(f"{kind} loads" for kind in sorted(taken)))


def _response_role(description: str) -> tuple[str, str]:
    """Rank and label from the words in which `reduce` describes its response."""
    if description.startswith("static"):
        return "static", "static matrix"
    if description.startswith("measured"):
        return "measured", "transfer function"
    words, _, effects = description.partition(" with ")
    form = words.partition(" ")[0]
    method, _, more = words.rpartition("(")[2].rstrip(")").partition(", ")
    if effects or method == "computed":
        return _role_with_effects(method, tuple(effects.split(", ")) if effects else ())
    if method not in METHOD_LABELS or form not in ("physical", "paper"):
        return "", description
    return _role_of_fit(form, method, ", full damping" if more == "full damping" else "")


def _assign_plot_styles(
    models: list[Source[Any]], loads: list[Source[Any]]
) -> tuple[tuple[Source[IdentifiedModel], ...], tuple[Source[HubLoads], ...]]:
    """A look for every label: that of its rank, and for a further label of one rank another colour."""
    looks: dict[str, PlotStyle] = {}
    taken: set[str] = set()
    further = iter(EXTRA_COLORS * 8)
    for source in (*models, *loads):
        if source.label in looks:
            continue
        plot_style = PLOT_STYLES.get(source.rank, PlotStyle(EXTRA_COLORS[0]))
        if source.rank in taken or source.rank not in PLOT_STYLES:
            plot_style = replace(plot_style, colour=next(further), dashes=(3, 1, 1, 1))
        looks[source.label] = plot_style
        taken.add(source.rank)
    return (
        tuple(replace(source, plot_style=looks[source.label]) for source in models),
        tuple(replace(source, plot_style=looks[source.label]) for source in loads),
    )
