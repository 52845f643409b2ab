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
from balance_cli.reduction.result import Loads
from balance_cli.report.figure_style import BLUE, DATA, GREEN, GREY, MORE, ORANGE, PURPLE, SKY, VERMILION, Look
from balance_cli.signals.transfer import Transfer

FORMATS: Mapping[str, type[Any]] = {
    "balance-calibration/1": Calibration,
    "balance-transfer/1": Transfer,
    "balance-model/1": IdentifiedModel,
    "balance-diagnosis/1": Diagnosis,
    "balance-loads/1": Loads,
}

T = TypeVar("T")

# In the order in which methods are compared: from what the paper started with to what it asks for.
RANKS = ("static", "measured", "computed", "paper-ls", "paper", "ls", "identified", "closed")
LOOKS = {
    "static": Look(GREY, (1, 1), "s"),
    "measured": Look(ORANGE, (6, 1.5, 1, 1.5), "D"),
    "computed": Look(VERMILION, (4, 1.5), "^"),
    "paper-ls": Look("#7fc8b0", (2, 1), "P"),
    "paper": Look(GREEN, (2, 1), "X"),
    "ls": Look(SKY, (5, 1), "v"),
    "identified": Look(BLUE, (), "o"),
    "closed": Look(PURPLE, (), "*"),
}
NAMED = 2
"""Effects of a model that its label names; more are counted."""
METHODS = {"ls": "LS", "ml": "ML", "ls+ml": "LS+ML"}


@dataclass(frozen=True)
class Source(Generic[T]):
    """One artefact: its file name, its content, and how the page calls and draws it."""

    file: str
    artefact: Artefact
    content: T
    rank: str = ""
    label: str = ""
    look: Look = DATA


@dataclass(frozen=True)
class Sources:
    """All artefacts of a page, each kind in the order in which it is shown."""

    calibrations: tuple[Source[Calibration], ...] = ()
    transfers: tuple[Source[Transfer], ...] = ()
    models: tuple[Source[IdentifiedModel], ...] = ()
    diagnoses: tuple[Source[Diagnosis], ...] = ()
    loads: tuple[Source[Loads], ...] = ()

    @property
    def everything(self) -> tuple[Source[Any], ...]:
        """All of them, in the order of a campaign."""
        return (*self.calibrations, *self.transfers, *self.models, *self.diagnoses, *self.loads)

    @property
    def geometries(self) -> tuple[Geometry, ...]:
        """The different geometries that the artefacts were made from, the declared effects aside."""
        declared = [source.content.geometry for source in self.everything]
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
    models = _distinct([_named_model(source) for source in of["balance-model/1"]])
    by_digest = {source.artefact.digest: source for source in models}
    loads = _distinct([_named_loads(source, by_digest) for source in of["balance-loads/1"]])
    drawn_models, drawn_loads = _with_looks(models, loads)
    return Sources(
        calibrations=_labelled(of["balance-calibration/1"], "calibration"),
        transfers=_labelled(of["balance-transfer/1"], "measurement"),
        models=drawn_models,
        diagnoses=_labelled(of["balance-diagnosis/1"], "diagnosis"),
        loads=drawn_loads,
    )


def _labelled(found: list[Source[Any]], label: str) -> tuple[Source[Any], ...]:
    """The sources of a kind that has one label only."""
    return tuple(_distinct([replace(source, label=label) for source in found]))


def _distinct(named: list[Source[Any]]) -> list[Source[Any]]:
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
    return sorted(distinct, key=lambda source: (_order(source.rank), source.label))


def _order(rank: str) -> int:
    return RANKS.index(rank) if rank in RANKS else len(RANKS)


def _named_model(source: Source[IdentifiedModel]) -> Source[IdentifiedModel]:
    rank, label = model_role(source.content)
    return replace(source, rank=rank, label=label)


def model_role(model: IdentifiedModel) -> tuple[str, str]:
    """Rank and label of a model by its form, its method and the effects in it."""
    effects = tuple(dict.fromkeys(effect.name for effect in model.geometry.effects))
    if effects or model.method == "computed":
        return _role_with_effects(model.method, effects)
    full = model.paper is not None and model.paper.options.damping == "full"
    return _fitted_role(model.form, model.method, ", full damping" if full else "")


def _role_with_effects(method: str, effects: tuple[str, ...]) -> tuple[str, str]:
    """Rank and label of a computed model, and of a fitted one with effects; many effects are counted, not named."""
    named = ", ".join(effects) if len(effects) <= NAMED else f"{len(effects)} effects"
    if method == "computed":
        return "computed", f"computed with {named}" if effects else "computed"
    return "closed", f"closed: {named}"


def _fitted_role(form: str, method: str, more: str = "") -> tuple[str, str]:
    """Rank and label of a model without effects that was fitted by this method; `more` ends its label."""
    words = METHODS.get(method, method) + more
    if form == "paper":
        return ("paper-ls" if method == "ls" else "paper"), f"paper\N{RIGHT SINGLE QUOTATION MARK}s form ({words})"
    return ("ls" if method == "ls" else "identified"), f"identified rigid ({words})"


def _named_loads(source: Source[Loads], models: Mapping[str, Source[IdentifiedModel]]) -> Source[Loads]:
    """Loads bear the label of the model that they were made with; without it that of their own description."""
    rank, label = _response_role(source.content.response)
    for item in source.artefact.provenance.inputs:
        if item.role == "model" and item.digest in models:
            rank, label = models[item.digest].rank, models[item.digest].label
    return replace(source, rank=rank, label=", ".join([label, *_method_words(source.content)]))


def _method_words(loads: Loads) -> tuple[str, ...]:
    """What a label adds to that of the response: the method, and what it knows of the loads where that is not usual."""
    if loads.method == "harmonic":
        return ()
    taken = {run.in_time.loads_as for run in loads.runs.values() if run.in_time is not None} - {"harmonics"}
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
    if method not in METHODS or form not in ("physical", "paper"):
        return "", description
    return _fitted_role(form, method, ", full damping" if more == "full damping" else "")


def _with_looks(
    models: list[Source[Any]], loads: list[Source[Any]]
) -> tuple[tuple[Source[IdentifiedModel], ...], tuple[Source[Loads], ...]]:
    """A look for every label: that of its rank, and for a further label of one rank another colour."""
    looks: dict[str, Look] = {}
    taken: set[str] = set()
    further = iter(MORE * 8)
    for source in (*models, *loads):
        if source.label in looks:
            continue
        look = LOOKS.get(source.rank, Look(MORE[0]))
        if source.rank in taken or source.rank not in LOOKS:
            look = replace(look, colour=next(further), dashes=(3, 1, 1, 1))
        looks[source.label] = look
        taken.add(source.rank)
    return (
        tuple(replace(source, look=looks[source.label]) for source in models),
        tuple(replace(source, look=looks[source.label]) for source in loads),
    )
