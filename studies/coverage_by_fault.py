"""Coverage of 95 % intervals of hub loads, and flags, by what is wrong with a campaign or its reduction.

Rig A has six cells for six loads: nothing tests its loads. A rigid model is fitted to it while an effect is undeclared.
The other classes are those of the sample rig. Records are short: what is counted are rows, not digits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.gaps import bridge_gaps
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.reduction.flags import (
    EXTRAPOLATED,
    MODEL_CONTRADICTED,
    NOT_STEADY,
    REDUNDANCY,
    UNMODELLED_LINE,
    UNTESTED,
)
from balance_cli.reduction.measured_response import transfer_source
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.response_sources import ResponseSource, static_source
from balance_cli.signals.response.choices import INTERPOLATIONS
from balance_cli.simulation import Campaign, CampaignPlan, RotorPlan, draw_rig, simulate_campaign
from balance_cli.simulation.extensions.base import Extension
from balance_cli.simulation.extensions.library import extension
from balance_cli.simulation.plans import LoadStep
from balance_cli.simulation.preset_plans import HARMONIC_SHAPE
from balance_cli.simulation.rig import TrueRig
from balance_cli.simulation.truth import RunTruth
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce import reduce_run
from balance_cli.steps.reduction_inputs import zero_reference
from balance_cli.steps.sweep_tf import estimate_responses
from studies.clean_campaigns import LEAST_DAMPING, covered_share, rows_of_run
from tests.support.other_rigs import other_rig, short_campaign

REVOLUTIONS = 100
SWEEP_PERIODS = 30.0
UNDECLARED: dict[str, tuple[Extension, ...]] = {
    "support": (extension("support-flexibility", ("x", "y"), mass=300.0, compliance_x=1e-7, compliance_y=1e-7),),
    "hose": (extension("parallel-stiffness", (), stiffness_x=4e5, stiffness_y=2e5, stiffness_z=4e5, z=0.1),),
    "delay": tuple(extension("time-delay", (name,), delay=1e-3) for name in ("l1.piezo", "l1.strain", "l4.piezo")),
    "mast": (extension("mast-bending", ("x", "y"), mass=6.0, compliance_x=4e-7, compliance_y=4e-7),),
}
"""Effects of rig A that change its response by some per cent to several times its size within the harmonics."""
GAP_SAMPLES, GAPS = 8, 4
"""Missing samples of a gap, and gaps of a channel: together below the 1 % up to which gaps are bridged."""
COUNTED = (UNTESTED, REDUNDANCY, NOT_STEADY, UNMODELLED_LINE, EXTRAPOLATED, MODEL_CONTRADICTED)


def fault_chunk(seed: int) -> pd.DataFrame:
    """Return one row for each load of the campaigns of a seed."""
    parts = [_undeclared(seed, label) for label in UNDECLARED]
    return pd.concat([*parts, *_sample_rig(seed)], ignore_index=True).assign(campaign=seed)


def _drawn_rig(letter: str, seed: int) -> TrueRig:
    rig = draw_rig(other_rig(letter), np.random.default_rng([seed, 17]))
    return replace(rig, damping_ratios=np.maximum(rig.damping_ratios, LEAST_DAMPING))


def _undeclared(seed: int, label: str) -> pd.DataFrame:
    """Rig A with an effect, reduced by the rigid model that was fitted to it."""
    rig = _drawn_rig("A", seed).with_extensions(*UNDECLARED[label])
    campaign = simulate_campaign(rig, short_campaign("A", SWEEP_PERIODS, REVOLUTIONS), seed=seed)
    geometry = other_rig("A")
    calibration = calibrate([run for run in campaign.runs if run.kind == "static"], geometry)
    source = model_source(identify(measured_spectra(campaign.runs, geometry), geometry))
    return _loads(f"six cells, {label} undeclared", campaign, calibration, source, ("check-1", "check-2", "wind-1"))


def _sample_rig(seed: int) -> Iterator[pd.DataFrame]:
    """The sample rig: as it should be, with faults of its records, and reduced by other responses."""
    campaign = simulate_campaign(_drawn_rig("D", seed), _plan_with_faults(), seed=seed)
    geometry = other_rig("D")
    calibration = calibrate([run for run in campaign.runs if run.kind == "static"], geometry)
    spectra, usual = measured_spectra(campaign.runs, geometry), ("check-1", "check-2", "wind-1")
    physical = model_source(identify(spectra, geometry))
    paper = model_source(identify(spectra, geometry, IdentifyOptions(form="paper")))
    transfer = transfer_source(estimate_responses(campaign.runs, geometry), INTERPOLATIONS[0])
    yield _loads("sample rig, nothing wrong", campaign, calibration, physical, usual)
    yield _loads("sample rig, collective step", campaign, calibration, physical, ("step",))
    yield _loads("sample rig, 9/rev not reduced", campaign, calibration, physical, ("nine",))
    gaps = np.random.default_rng([seed, 9])
    yield _loads("sample rig, gaps", campaign, calibration, physical, usual, lambda run: _with_gaps(run, gaps))
    yield _loads("sample rig, static matrix", campaign, calibration, static_source(calibration), usual)
    yield _loads("sample rig, paper's form", campaign, calibration, paper, usual)
    yield _loads("sample rig, measured response", campaign, calibration, transfer, usual)


def _plan_with_faults() -> CampaignPlan:
    """The short campaign of the sample rig with two further runs: one with a collective step, one with a 9/rev."""
    plan = short_campaign("D", SWEEP_PERIODS, REVOLUTIONS)
    nine = short_campaign("D", SWEEP_PERIODS, REVOLUTIONS, (*HARMONIC_SHAPE, 2.0)).runs[-1]
    wind = plan.runs[-1]
    assert isinstance(wind, RotorPlan)
    step = LoadStep(time=0.6 * wind.duration, loads={"Fz": 0.5 * wind.steady["Fz"]})
    further = (wind.model_copy(update={"run": "step", "step": step}), nine.model_copy(update={"run": "nine"}))
    return CampaignPlan(runs=(*plan.runs, *further))


def _with_gaps(run: Run, rng: np.random.Generator) -> Run:
    """Return the run with gaps in every channel, bridged as where a record is read."""
    block = run.read()
    channels = block.channels.copy()
    for column in range(channels.shape[1]):
        for start in rng.choice(len(channels) // 64 - 2, GAPS, replace=False) * 64 + 64:
            channels[start : start + GAP_SAMPLES, column] = np.nan
    return bridge_gaps(replace(run, source=MemorySource(channels, block.loads)))


def _loads(
    label: str,
    campaign: Campaign,
    calibration: Calibration,
    source: ResponseSource,
    names: Sequence[str],
    change: Callable[[Run], Run] = lambda run: run,
) -> pd.DataFrame:
    geometry = calibration.geometry
    zero = zero_reference([run for run in campaign.runs if run.kind == "zero"], calibration)
    rows = []
    for run, truth in zip(campaign.runs, campaign.truths, strict=True):
        if run.name in names:
            loads = reduce_run(change(run), geometry, calibration, source, zero)
            rows += list(rows_of_run(loads, _within(truth, loads.interval)))
    return pd.DataFrame(rows).assign(fault=label)


def _within(truth: RunTruth, interval: tuple[float, float]) -> RunTruth:
    """Return the truth with the harmonics of the interval that was reduced."""
    cosine, sine = truth.harmonics(*interval)
    return replace(truth, cosine=cosine, sine=sine)


def fault_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows, coverage of all and of those without a flag, and the shares with each flag, by class.

    `untested` alone does not count as a flag there: it stands on every row of rig A.
    """
    table = []
    for label, part in rows.groupby("fault", sort=False):
        flags = part["flag"].fillna("")
        shares = {flag: float(flags.str.contains(flag, regex=False).mean()) for flag in COUNTED}
        plain = part[~flags.str.contains("|".join(COUNTED[1:]))]
        row = {"fault": label, "rows": len(part), "coverage": covered_share(part)}
        table.append({**row, "rows without flag": len(plain), "their coverage": covered_share(plain), **shares})
    return pd.DataFrame(table)
