"""The score test of a candidate against its refit: the first round of the search on the sample campaign.

Both on the same lines, under the same model error. All candidates are scored; the leading ones are refitted.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from balance_cli.campaign.recording.run_file import open_run
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.diagnosis.search.candidates import candidates
from balance_cli.diagnosis.search.refit import fit_partially, fit_until_stable
from balance_cli.diagnosis.search.rounds import rank_candidates, select_leading
from balance_cli.diagnosis.search.search_lines import search_lines
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.model.balance import balance_model
from balance_cli.steps.identify import identify

ROOT = Path(__file__).parents[1]


def run() -> str:
    """Time both, and say the ratio."""
    geometry = load_geometry(ROOT / "configs" / "rts-6.yaml")
    runs = [open_run(path) for path in sorted((ROOT / "sample_data").glob("s*.h5"))]
    spectra = measured_spectra(runs, geometry, means=True)
    lines = search_lines(spectra, geometry.channel_names, SETTINGS.fit)
    rigid = np.array(identify(spectra, geometry).parameters.value, float)
    state = fit_until_stable(balance_model(geometry).at(rigid), lines, SETTINGS.fit)
    start = time.perf_counter()
    ranked = rank_candidates(state, lines, candidates(state.geometry), SETTINGS)
    score = (time.perf_counter() - start) / len(ranked)
    text = [f"score  {1e3 * score:9.2f} ms each of {len(ranked)}"]
    for leading in select_leading(ranked, SETTINGS):
        start = time.perf_counter()
        partial = fit_partially(state, leading, lines, SETTINGS)
        fit_until_stable(partial, lines, SETTINGS.fit, state.shares)
        refit = time.perf_counter() - start
        text.append(f"refit  {1e3 * refit:9.2f} ms, {refit / score:.0f} times that: {leading.candidate.label}")
    return "\n".join(text)
