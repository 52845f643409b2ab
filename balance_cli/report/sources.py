"""The artefacts of a page, sorted by kind, each with its label, role and plot style."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.result import Diagnosis
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.io.artefacts import Artefact
from balance_cli.io.formats import (
    ARTEFACT_FORMATS,
    CALIBRATION_FORMAT,
    DIAGNOSIS_FORMAT,
    LOADS_FORMAT,
    MODEL_FORMAT,
    SPECTRA_FORMAT,
    TRANSFER_FORMAT,
)
from balance_cli.planning.stored_forecast import StoredPlan
from balance_cli.reduction.result import HubLoads
from balance_cli.reduction.spectra_result import LoadSpectra
from balance_cli.report.figure_style import DATA_STYLE, EXTRA_COLORS, PlotStyle
from balance_cli.report.source_roles import PLOT_STYLES, ROLE_ORDER, SourceRole, loads_role, method_labels, model_role
from balance_cli.signals.response.transfer import Transfer

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Source(Generic[T]):
    """One artefact: its file name, its content, and its label, role and plot style on the page.

    Sources are compared by identity: contents have arrays, and a file may be given twice.
    """

    file: str
    artefact: Artefact
    content: T
    role: SourceRole = SourceRole.OTHER
    label: str = ""
    plot_style: PlotStyle = DATA_STYLE


@dataclass(frozen=True)
class Sources:
    """All artefacts of a page, each kind in the order in which it is shown, and the run files given with them."""

    calibrations: tuple[Source[Calibration], ...] = ()
    transfers: tuple[Source[Transfer], ...] = ()
    models: tuple[Source[IdentifiedModel], ...] = ()
    diagnoses: tuple[Source[Diagnosis], ...] = ()
    loads: tuple[Source[HubLoads], ...] = ()
    spectra: tuple[Source[LoadSpectra], ...] = ()
    runs: tuple[Run, ...] = ()
    plans: tuple[StoredPlan, ...] = ()

    @property
    def all_sources(self) -> tuple[Source[Any], ...]:
        """All artefacts, in the order of a campaign."""
        return (*self.calibrations, *self.transfers, *self.models, *self.diagnoses, *self.loads, *self.spectra)

    @property
    def geometries(self) -> tuple[Geometry, ...]:
        """The different geometries that the artefacts were made from, without their declared effects."""
        different: list[Geometry] = []
        for source in self.all_sources:
            geometry = source.content.geometry.model_copy(update={"effects": ()})
            if geometry not in different:
                different.append(geometry)
        return tuple(different)


def group_sources(
    artefacts: Sequence[tuple[Path, Artefact]], runs: Sequence[Run] = (), plans: Sequence[StoredPlan] = ()
) -> Sources:
    """Sort artefacts by kind and give each its label; equal labels are completed by the names of the files."""
    by_format: dict[str, list[Source[Any]]] = {format: [] for format in ARTEFACT_FORMATS}
    for path, artefact in artefacts:
        by_format[artefact.format].append(Source(path.name, artefact, artefact.content))
    models = _sort_by_role(_make_labels_unique([_label_model(source) for source in by_format[MODEL_FORMAT]]))
    by_digest = {source.artefact.digest: source for source in models}
    labeled_loads = [_label_loads(source, by_digest) for source in by_format[LOADS_FORMAT]]
    loads = _sort_by_role(_make_labels_unique(labeled_loads))
    plot_styles = _assign_plot_styles([*models, *loads])
    return Sources(
        calibrations=_label_sources(by_format[CALIBRATION_FORMAT], "calibration"),
        transfers=_label_sources(by_format[TRANSFER_FORMAT], "measurement"),
        models=tuple(replace(source, plot_style=plot_styles[source.label]) for source in models),
        diagnoses=_label_sources(by_format[DIAGNOSIS_FORMAT], "diagnosis"),
        loads=tuple(replace(source, plot_style=plot_styles[source.label]) for source in loads),
        spectra=_label_sources(by_format[SPECTRA_FORMAT], "spectra"),
        runs=tuple(runs),
        plans=tuple(plans),
    )


def _label_sources(sources: Sequence[Source[Any]], label: str) -> tuple[Source[Any], ...]:
    """The sources of a kind whose members all have one label, in the order in which they were given."""
    return tuple(_make_labels_unique([replace(source, label=label) for source in sources]))


def _label_model(source: Source[IdentifiedModel]) -> Source[IdentifiedModel]:
    role, label = model_role(source.content)
    return replace(source, role=role, label=label)


def _label_loads(source: Source[HubLoads], models: Mapping[str, Source[IdentifiedModel]]) -> Source[HubLoads]:
    """Loads take the label of the model that they were reduced with, where it is on the page."""
    role, label = loads_role(source.content)
    for item in source.artefact.provenance.inputs:
        if item.role == "model" and item.digest in models:
            role, label = models[item.digest].role, models[item.digest].label
    return replace(source, role=role, label=", ".join([label, *method_labels(source.content)]))


def _make_labels_unique(sources: Sequence[Source[Any]]) -> list[Source[Any]]:
    """The same sources with different labels."""
    count = Counter(source.label for source in sources)
    labeled = [
        replace(source, label=f"{source.label}, {Path(source.file).stem}") if count[source.label] > 1 else source
        for source in sources
    ]
    return list(_number_equal_labels(labeled))


def _sort_by_role(sources: Sequence[Source[Any]]) -> list[Source[Any]]:
    return sorted(sources, key=lambda source: (ROLE_ORDER.index(source.role), source.label))


def _number_equal_labels(sources: Sequence[Source[Any]]) -> Iterator[Source[Any]]:
    """Number the sources that have one label: files of one name in different folders."""
    count = Counter(source.label for source in sources)
    number: Counter[str] = Counter()
    for source in sources:
        number[source.label] += 1
        yield replace(source, label=f"{source.label} ({number[source.label]})") if count[source.label] > 1 else source


def _assign_plot_styles(sources: Sequence[Source[Any]]) -> dict[str, PlotStyle]:
    """{label: plot style}: that of the role, and another color for every further label of one role."""
    plot_styles: dict[str, PlotStyle] = {}
    used_roles: set[SourceRole] = set()
    extra_colors = iter(EXTRA_COLORS * 8)
    for source in sources:
        if source.label in plot_styles:
            continue
        plot_style = PLOT_STYLES.get(source.role, PlotStyle(EXTRA_COLORS[0]))
        if source.role in used_roles or source.role not in PLOT_STYLES:
            plot_style = replace(plot_style, color=next(extra_colors), dashes=(3, 1, 1, 1))
        plot_styles[source.label] = plot_style
        used_roles.add(source.role)
    return plot_styles
