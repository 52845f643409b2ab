"""A diagnosis made by hand, and an engine that returns it: for the command and the page, not for the loop itself."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.result import (
    EXPLAINED,
    Diagnosis,
    Evidence,
    FoundEffect,
    HoldOut,
    ModelFreeTest,
    ResidualMap,
    RunErrors,
    Trial,
    UntestableEffect,
)
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.model.fitted_effects import FittedParameter
from tests.support.report_content import model


def support_effect() -> FoundEffect:
    """A strong effect, which another one could stand for."""
    return FoundEffect(
        name="support-flexibility",
        where=("x", "theta"),
        parameters=(
            FittedParameter("compliance_x", 2.13e-8, 4.1e-10, "m/N", (1.9e-8, 2.9e-8)),
            FittedParameter("mass", 512.0, 23.0, "kg"),
            FittedParameter("damping_ratio", 0.021, float("inf"), "1"),
        ),
        evidence=Evidence(1.234e6, 3, 0.0, 0.9e6, 3.1e5, 1),
        indistinguishable_from=("mast-bending@x",),
        separated_by="a tap on the support",
    )


def delay_effect() -> FoundEffect:
    """A weaker one, alone."""
    return FoundEffect(
        name="time-delay",
        where=("z1.piezo",),
        parameters=(FittedParameter("delay", 2.5e-4, 3e-6, "s"),),
        evidence=Evidence(812.3, 1, 2.2e-150, 790.0, 401.0, 2),
        worth={"Fz": 31.0, "Mx": 4.2},
    )


def residual_map(geometry: Geometry, runs: tuple[str, ...] = ("sweep-Fx-low", "sweep-Fx-high")) -> ResidualMap:
    """Large between 55 and 75 Hz before, one everywhere after; the static run has no line above 0 Hz."""
    edges = np.array([0.0, 1.0, *np.linspace(5.0, 150.0, 30)])
    channels = geometry.channel_names
    middle = 0.5 * (edges[1:] + edges[:-1])
    shape = 1.0 + 90.0 * np.exp(-0.5 * ((middle - 65.0) / 6.0) ** 2)
    before = (
        shape[None, :, None] * np.linspace(0.5, 1.5, len(channels)) * np.linspace(0.5, 1.0, len(runs))[:, None, None]
    )
    before[:, 0] = np.nan
    static = np.full((1, *before.shape[1:]), np.nan)
    static[:, 0] = 4.0
    before = np.concatenate([static, before])
    after = np.where(np.isfinite(before), 1.0, np.nan)
    return ResidualMap(("static-bare", *runs), channels, edges, before, after)


def hold_out() -> dict[str, HoldOut]:
    """A check run and a sweep."""
    check = HoldOut(
        before=RunErrors({"Fz": 0.0546, "My": 12.7}, {"Fx": 7.55, "Mz": 0.0062}, 0.101),
        after=RunErrors({"Fz": 0.0006, "My": 0.0031}, {"Fx": 0.0017, "Mz": 0.0002}, 0.0008),
        noise=RunErrors({"Fz": 0.00045, "My": 0.0025}, {"Fx": 0.0014, "Mz": 0.00018}, 0.0005),
    )
    sweep = HoldOut(RunErrors({}, {}, 0.09), RunErrors({}, {}, 0.0006), RunErrors({}, {}, 0.00055))
    return {"check-1": check, "sweep-Mz-high": sweep}


def trials() -> tuple[Trial, ...]:
    """Two rounds and a removal."""
    nan = float("nan")
    return (
        Trial(
            round=1,
            label="support-flexibility@x,theta",
            score=0.9e6,
            parameters=3,
            p_value=0.0,
            gain=1.2e6,
            decision="accepted",
            reason="lowers the error on the folds",
        ),
        Trial(
            round=1,
            label="mast-bending@x",
            score=0.8e6,
            parameters=3,
            p_value=0.0,
            gain=1.1e6,
            decision="rejected",
            reason="gains less",
        ),
        Trial(
            round=1,
            label="channel-gain@x.piezo",
            score=12.0,
            parameters=1,
            p_value=0.3,
            gain=nan,
            decision="not refitted",
            reason="within chance",
        ),
        Trial(
            round=2,
            label="time-delay@z1.piezo",
            score=790.0,
            parameters=1,
            p_value=2.2e-150,
            gain=812.3,
            decision="accepted",
        ),
        Trial(
            round=3,
            label="added-mass",
            score=3.1,
            parameters=1,
            p_value=0.9,
            gain=nan,
            decision="not refitted",
            reason="within chance",
        ),
        Trial(
            round=4,
            label="support-flexibility@x,theta",
            score=nan,
            parameters=3,
            p_value=nan,
            gain=1.234e6,
            decision="kept",
            reason="needed beside the others",
        ),
    )


def diagnosis(verdict: str = EXPLAINED, **changes: object) -> Diagnosis:
    """Of the sample balance: two effects found, unless told otherwise."""
    first, last = model(chi2_per_dof=2300.0), model(scale=0.5)
    made = Diagnosis(
        geometry=first.geometry,
        verdict=verdict,
        effects=(support_effect(), delay_effect()),
        trials=trials(),
        data_tests=(
            ModelFreeTest("two channels of one cell", "z1", 812.0, 120.0, 1e-99, "z1.piezo is 0.25 ms late"),
            ModelFreeTest("low level against high", "Fx", 118.0, 120.0, 0.53, "alike"),
        ),
        untestable_effects=(
            UntestableEffect("gyroscopic-coupling", "all runs are at rest; sweep with a spinning rotor"),
        ),
        chi2_per_dof_before=2300.0,
        chi2_per_dof_after=1.04,
        frf_error_before=0.07,
        frf_error_after=0.0011,
        modes_before=first.modes,
        modes_after=last.modes,
        residual=residual_map(first.geometry),
        candidate_count=61,
        notes=("2 of 3 starts of support-flexibility came to the same minimum",),
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def fake_diagnose_module(engine: FakeDiagnose | None = None) -> ModuleType:
    """A module to stand for `balance_cli.steps.diagnose` while a command is tested."""
    module = ModuleType("balance_cli.steps.diagnose")
    module.diagnose = engine or FakeDiagnose()  # type: ignore[attr-defined]
    return module


class FakeDiagnose:
    """Stands for the loop: closes any model with itself, and remembers what it was given."""

    def __init__(self, verdict: str = EXPLAINED) -> None:
        self.verdict = verdict
        self.spectra: Spectra | None = None
        self.settings = DEFAULT_SETTINGS

    def __call__(self, before, spectra, settings=DEFAULT_SETTINGS, progress=None) -> tuple[Diagnosis, IdentifiedModel]:
        self.spectra, self.settings = spectra, settings
        if progress is not None:
            progress("residual", 0.2)
            progress("done", 1.0)
        found = {} if self.verdict == EXPLAINED else {"effects": ()}
        made = diagnosis(self.verdict, geometry=before.geometry, residual=residual_map(before.geometry), **found)
        return made, before
