"""Clean campaigns on five rigs: how many rows are flagged although nothing is wrong, and whether intervals cover.

Each campaign is a rig sampled from the tolerances, simulated in time, with the standard noise. Its records are short:
what is counted are rows, not digits.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pandas as pd

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.reduction.flags import FLAGS, SEPARATOR, UNTESTED
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.result import RunLoads
from balance_cli.signals.rotor.pulse_consistency import pulse_faults
from balance_cli.simulation import Campaign, draw_rig, simulate_campaign
from balance_cli.simulation.truth import RunTruth
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.identify import identify
from balance_cli.steps.reduce import reduce_run
from balance_cli.steps.reduction_inputs import zero_reference
from tests.support.other_rigs import RIGS, other_rig, short_campaign

LEAST_DAMPING = 0.004
"""Damping ratio below which a sampled one is not let: the tolerance of 50 % reaches zero."""
Z_95 = 1.959963984540054
UNTESTED_BY_DESIGN = {
    "A": "F[xyz]|M[xyz]",
    "B": "Mz",
    "C": "Mz",
    "D": "Mz|Fx 0",
    "E": "(?!)",
}
"""Loads (component and harmonic) of each rig that rest on one sensor. A has as many cells as loads. In B, C and D the
torque meter is beside the plate; one cell of D alone tells the mean of Fx. E has twelve cells and no torque meter."""
UNTESTED_BY_LOADS = {"D": "My 0"}
"""Those that may be untested or not: the mean of My contains what that cell reads of Fx."""


def clean_chunk(seed: int) -> pd.DataFrame:
    """Return one row for each load of the campaign of this number; the rigs take turns."""
    letter = RIGS[seed % len(RIGS)]
    geometry = other_rig(letter)
    rig = draw_rig(geometry, np.random.default_rng([seed, 5]))
    rig = replace(rig, damping_ratios=np.maximum(rig.damping_ratios, LEAST_DAMPING))
    campaign = simulate_campaign(rig, short_campaign(letter), seed=seed)
    calibration = calibrate([run for run in campaign.runs if run.kind == "static"], geometry)
    source = model_source(identify(measured_spectra(campaign.runs, geometry), geometry))
    return pd.DataFrame(load_rows(campaign, calibration, source)).assign(rig=letter, campaign=seed)


def load_rows(campaign: Campaign, calibration: object, source: ResponseSource) -> Iterator[dict[str, object]]:
    """Yield run, harmonic, component, flags, errors over sigma and relative sigma of every load of a campaign."""
    geometry = calibration.geometry  # type: ignore[attr-defined]
    zero = zero_reference([run for run in campaign.runs if run.kind == "zero"], calibration)  # type: ignore[arg-type]
    for run, truth in zip(campaign.runs, campaign.truths, strict=True):
        if run.kind in ("check", "wind"):
            loads = reduce_run(run, geometry, calibration, source, zero)  # type: ignore[arg-type]
            faults = len(list(pulse_faults(run)))
            yield from ({**row, "pulse_faults": faults} for row in rows_of_run(loads, truth))


def rows_of_run(loads: RunLoads, truth: RunTruth) -> Iterator[dict[str, object]]:
    """Yield harmonic, component, flag, errors over sigma and relative sigma of every load of a run."""
    assert truth.cosine is not None and truth.sine is not None
    columns = [COMPONENTS.index(name) for name in loads.components]
    true = (truth.cosine - 1j * truth.sine)[: len(loads.amplitude), columns]
    error = loads.amplitude - true
    with np.errstate(invalid="ignore", divide="ignore"):
        parts = (error.real / loads.sigma_cosine, error.imag / loads.sigma_sine)
    for h, m in np.ndindex(error.shape):
        sigma = np.hypot(loads.sigma_cosine[h, m], loads.sigma_sine[h, m])
        yield {
            "run": loads.run,
            "harmonic": h,
            "component": loads.components[m],
            "flag": loads.flags[h][m],
            "z_cosine": parts[0][h, m],
            "z_sine": parts[1][h, m] if h else np.nan,
            "relative_error": abs(error[h, m]) / max(abs(true[h, m]), 1e-12),
            "relative_sigma": sigma / max(abs(true[h, m]), 1e-12),
            "notes": SEPARATOR.join(loads.notes),
        }


def clean_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return campaigns, rows, rows with each flag by mistake, and the coverage of 95 % intervals, by rig."""
    table = []
    for letter, part in rows.groupby("rig"):
        flags = part["flag"].fillna("")
        counts = {flag: int(flags.str.contains(flag, regex=False).sum()) for flag in FLAGS}
        load = part["component"] + " " + part["harmonic"].astype(str)
        allowed = load.str.fullmatch(UNTESTED_BY_LOADS.get(str(letter), "(?!)"))
        expected = load.str.match(UNTESTED_BY_DESIGN[str(letter)] + r"\b")
        mistaken = flags.str.contains(UNTESTED, regex=False) != expected
        counts[UNTESTED] = int((mistaken & ~allowed).sum())
        table.append(
            {
                "rig": letter,
                "campaigns": part["campaign"].nunique(),
                "rows": len(part),
                "coverage": covered_share(part),
                **counts,
                "pulse_faults": int(part["pulse_faults"].sum()),
                "noted": int(part["notes"].fillna("").ne("").sum()),
            }
        )
    return pd.DataFrame(table)


def covered_share(rows: pd.DataFrame) -> float:
    """Return the share of true cosines and sines within their 95 % intervals."""
    z = np.concatenate([rows["z_cosine"], rows["z_sine"]])
    return float(np.mean(np.abs(z[np.isfinite(z)]) < Z_95))
