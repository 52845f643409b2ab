"""The steps of the chain: which commands a campaign allows, in which order, and why others are left out."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.cli.pipeline.inventory import Inventory, RunFile
from balance_cli.io.errors import UserError

PAPER_FORMS = {"paper": ("--form", "paper"), "paper-full": ("--form", "paper", "--damping", "full")}
BEST_FIRST = ("given", "closed", "rigid", "transfer", "computed")
"""Responses in the order in which their loads are preferred: given, updated, identified, measured, computed."""
LOWEST_FREQUENCY = 1.0
"""[Hz] from which spectra are reduced: below lie the drift of channels and the high-pass of piezo channels."""
MOST_RECORDS = 6
"""Wind runs whose raw channels are on the page: each adds about 0.2 MB."""
SHARE_OF_CUTOFF, SHARE_OF_RATE = 0.8, 0.4
"""Of the cut-off of the anti-alias filter, and of the sample rate: up to the smaller one spectra are reduced."""


@dataclass(frozen=True)
class Step:
    """One command of the chain.

    `words` are the command and its options; a word that is a Path is a file, read or written. `reads` are inputs that
    must be there; of `reads_if_there` those are appended that were made; of `reads_first_of` the first that was made.
    `writes` are the outputs. An `optional` step may be refused by the command: its comparison is then not possible.
    """

    name: str
    words: tuple[str | Path, ...]
    reads: tuple[Path, ...]
    writes: tuple[Path, ...]
    reads_if_there: tuple[Path, ...] = ()
    reads_first_of: tuple[Path, ...] = ()
    optional: bool = False

    @property
    def writes_in(self) -> tuple[Path, ...]:
        """The folder of load histories that the step writes besides, if any."""
        return (Path(self.words[self.words.index("--history") + 1]),) if "--history" in self.words else ()

    def arguments(self, is_there: Iterable[Path]) -> list[str]:
        """Return the words of the command, with the inputs of which only some need to be there."""
        there = set(is_there)
        some = [path for path in self.reads_if_there if path in there]
        first = [path for path in self.reads_first_of if path in there][:1]
        command, *options = self.words
        return [str(word) for word in (command, *first, *some, *options)]

    def inputs(self, is_there: Iterable[Path]) -> tuple[Path, ...]:
        """Return the inputs that are used where these files are there."""
        there = set(is_there)
        some = [path for path in self.reads_if_there if path in there]
        first = [path for path in self.reads_first_of if path in there][:1]
        return (*self.reads, *first, *some)


@dataclass(frozen=True)
class Plan:
    """The steps in an order in which they can be done, and what is left out {name: reason}."""

    steps: tuple[Step, ...]
    left_out: dict[str, str] = field(default_factory=dict)


def plan_steps(campaign: Inventory, results: Path, band: tuple[float, float] | None = None) -> Plan:
    """Return the steps that a campaign allows, with outputs in the folder `results`.

    Models are identified from lines within `band` [Hz], all without it; the diagnosis has the band of its model.
    Raises UserError for a band where no sweep is there.
    """
    if band is not None and not campaign.of_kind("sweep"):
        raise UserError("no sweep is there, so no model is identified", "--band", remedy="Leave it out")
    builder = _Builder(campaign, results, () if band is None else ("--band", *map(str, band)))
    builder.add("modes", "modes", "-g", campaign.geometry_path, json=True, writes=())
    builder.add_calibration()
    builder.add_models()
    builder.add_diagnosis()
    builder.add_reductions()
    builder.add_report()
    return Plan(tuple(builder.steps), builder.left_out)


class _Builder:
    """Collects the steps; `made` are all outputs so far."""

    def __init__(self, campaign: Inventory, results: Path, band: tuple[str, ...]) -> None:
        self.steps: list[Step] = []
        self.left_out: dict[str, str] = {}
        self._campaign, self._results, self._band = campaign, results, band
        self._static, self._sweeps = _paths(campaign.of_kind("static")), _paths(campaign.of_kind("sweep"))
        self._checks = _paths(campaign.of_kind("check"))

    def add(
        self,
        name: str,
        *words: str | Path,
        writes: tuple[Path, ...],
        json: bool = False,
        optional: bool = False,
        if_there: tuple[Path, ...] = (),
        first_of: tuple[Path, ...] = (),
    ) -> None:
        """Add a step; what it reads are the paths among its words that it does not write."""
        if json:
            summary = self._path(f"{name}.json")
            words, writes = (*words, "--json", summary), (*writes, summary)
        reads = tuple(word for word in words if isinstance(word, Path) and word not in writes)
        self.steps.append(Step(name, words, reads, writes, if_there, first_of, optional))

    def add_calibration(self) -> None:
        """Add the static calibration and the frequency responses."""
        geometry = self._campaign.geometry
        if self._campaign.given_path("calibration") is not None:
            self.left_out["calibration"] = "another one was given"
        elif not self._static:
            self.left_out["calibration"] = "no static run: mean loads are not measured"
        elif not any(channel.measures_dc for channel in geometry.channels):
            self.left_out["calibration"] = "no channel passes a constant load: mean loads are not measured"
        else:
            self._add_from_runs("calibration", "calibrate", self._static)
        campaign_sweeps = self._campaign.of_kind("sweep")
        if self._sweeps:
            # Forces beside the hub that drive several loads at once give no responses, but a model.
            at_points = any(run.has_points for run in campaign_sweeps)
            self._add_from_runs("transfer", "sweep-tf", self._sweeps, optional=at_points)
        else:
            self.left_out["transfer"] = "no sweep: no frequency response, and no model is identified"

    def add_models(self) -> None:
        """Add the computed model and those identified from sweeps."""
        runs = (*self._static, *self._sweeps)
        self._add_from_runs("model-computed", "identify", runs, "--method", "computed")
        if not self._sweeps:
            return
        self._add_from_runs("model-rigid", "identify", runs, *self._band)
        refusal = paper_form_refusal(self._campaign.geometry)
        for name, options in PAPER_FORMS.items():
            if refusal:
                self.left_out[f"model-{name}"] = refusal
            else:
                self._add_from_runs(f"model-{name}", "identify", self._sweeps, *options, *self._band, optional=True)

    def add_diagnosis(self) -> None:
        """Add model updating, from the rigid model; check runs are held out and only measure the errors."""
        if not self._sweeps:
            return
        diagnosis, model = self._path("diagnosis.h5"), self._path("model-closed.h5")
        held_out = [word for path in self._checks if self._has_pulses(path) for word in ("--hold-out", path)]
        words = ("diagnose", self._path("model-rigid.h5"), *self._static, *self._sweeps, *held_out)
        words = (*words, "-o", diagnosis, "--model-out", model)
        self.add("diagnosis", *words, writes=(diagnosis, model), json=True)

    def add_reductions(self) -> None:
        """Add the reductions by every response, in time, and the tables of the best response."""
        rotor = _paths(run for run in self._campaign.of_kind("check", "wind") if run.has_pulses)
        self._add_spectra()
        if not rotor:
            self.left_out["loads"] = "no check or wind run with 1/rev pulses: no harmonic loads"
            return
        calibration = self._calibration()
        for name in self._responses(bool(calibration)):
            self._add_reduction(name, name, rotor, optional=name not in ("given", "closed", "rigid", "computed"))
        loads = tuple(self._path(f"loads-{name}.h5") for name in BEST_FIRST if self._is_planned(f"loads-{name}"))
        self._add_table("loads", loads)
        zeros = self._campaign.of_kind("zero")
        for run in zeros[1:]:
            self.left_out[run.name] = f"{zeros[0].name} is the zero; a reduction has one"
        if self._is_planned("loads-transfer"):
            self._add_table("loads-transfer.csv", (self._path("loads-transfer.h5"),))
        wind = _paths(run for run in self._campaign.of_kind("wind") if run.has_pulses)
        if self._sweeps and wind:
            options = ("--method", "smoother", "--history", str(self._path("histories")))
            self._add_reduction("smoother", "closed", wind, *options, optional=True)

    def _add_spectra(self) -> None:
        """Add spectral densities of the records without 1/rev pulses."""
        runs = [run for run in self._campaign.of_kind("check", "wind") if not run.has_pulses]
        if not runs:
            return
        rate = min(run.sample_rate or math.inf for run in runs)
        declared = self._campaign.geometry.acquisition.filter
        highest = min(SHARE_OF_RATE * rate, SHARE_OF_CUTOFF * declared.cutoff if declared else math.inf)
        own = "closed" if self._sweeps else "computed"
        best = own if self._campaign.given_path("model") is None else "given"
        spectra, response = self._path("spectra.h5"), self._response(best)
        words: tuple[str | Path, ...] = ("reduce", *response, *_paths(runs))
        band = ("--band", f"{LOWEST_FREQUENCY:g}", f"{highest:g}", "-o", spectra)
        self.add("spectra", *words, *band, writes=(spectra,), json=True)
        self._add_table("spectra.csv", (spectra,))

    def add_report(self) -> None:
        """Add the report of everything that was made."""
        outputs = [path for step in self.steps for path in step.writes]
        parts = [path for path in outputs if path.suffix == ".h5"]
        page = self._path("report.html")
        records = _paths(self._campaign.of_kind("wind"))[:MOST_RECORDS]
        self.add("report", "report", *records, "-o", page, writes=(page,), if_there=tuple(parts))

    def _add_table(self, name: str, loads: tuple[Path, ...]) -> None:
        table = self._path(Path(name).stem + ".csv")
        self.add(name, "export", "-o", table, writes=(table,), first_of=loads)

    def _add_reduction(self, name: str, response: str, runs: tuple[Path, ...], *options: str, optional: bool) -> None:
        loads, zeros = self._path(f"loads-{name}.h5"), _paths(self._campaign.of_kind("zero"))
        zero: tuple[str | Path, ...] = ("--zero", zeros[0]) if zeros and self._calibration() else ()
        inputs: tuple[str | Path, ...] = (*self._calibration(), *self._response(response), *runs)
        words: tuple[str | Path, ...] = ("reduce", *inputs, *options, *zero, "-o", loads)
        self.add(f"loads-{name}", *words, writes=(loads,), json=True, optional=optional)

    def _response(self, name: str) -> tuple[str | Path, ...]:
        if name == "static":
            return ("--static",)
        if name == "transfer":
            return ("--transfer", self._path("transfer.h5"))
        given = self._campaign.given_path("model")
        if name == "given" and given is not None:
            return ("--model", given)
        return ("--model", self._path(f"model-{name}.h5"))

    def _responses(self, has_calibration: bool) -> list[str]:
        models = [step.name.removeprefix("model-") for step in self.steps if step.name.startswith("model-")]
        static = ["static"] if has_calibration else []
        static += ["given"] if self._campaign.given_path("model") is not None else []
        return [*static, *(["transfer", *models, "closed"] if self._sweeps else models)]

    def _calibration(self) -> tuple[str | Path, ...]:
        given = self._campaign.given_path("calibration")
        own = self._path("calibration.h5") if self._is_planned("calibration") else None
        calibration = given or own
        return () if calibration is None else ("--calibration", calibration)

    def _add_from_runs(
        self, name: str, command: str, runs: tuple[Path, ...], *options: str, optional: bool = False
    ) -> None:
        output = self._path(f"{name}.h5")
        words: tuple[str | Path, ...] = (command, "-g", self._campaign.geometry_path, *runs, *options, "-o", output)
        self.add(name, *words, writes=(output,), json=True, optional=optional)

    def _is_planned(self, name: str) -> bool:
        return any(step.name == name for step in self.steps)

    def _has_pulses(self, path: Path) -> bool:
        return any(run.path == path and run.has_pulses for run in self._campaign.of_kind("check"))

    def _path(self, name: str) -> Path:
        return self._results / name


def paper_form_refusal(geometry: Geometry) -> str:
    """Return why the paper's form does not fit a rig; empty where it does."""
    from balance_cli.estimation.paper.sensors import sensor_rule

    try:
        sensor_rule(geometry)
    except UserError as error:
        return error.fault
    return ""


def _paths(runs: Iterable[RunFile]) -> tuple[Path, ...]:
    return tuple(run.path for run in runs)
