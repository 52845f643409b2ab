"""Clean campaigns on five rigs through the commands themselves: every warning is a false one.

The campaigns are those of `clean_campaigns`. `check` and `reduce` say all that the program knows to say of runs: noise,
delays, tare points, signs, exchanged channels, pulses, filters, contradictions of check runs and of trims.
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from click.testing import CliRunner

from balance_cli.campaign.recording.run_file import write_run
from balance_cli.campaign.rig.geometry_file import save_geometry
from balance_cli.cli import balance
from balance_cli.reduction.flags import SEPARATOR, UNTESTED
from balance_cli.simulation import draw_rig, simulate_campaign
from studies.clean_campaigns import LEAST_DAMPING
from tests.support.other_rigs import RIGS, other_rig, short_campaign

WARNING = "balance: warning: "
OTHER_KIND = re.compile(r" left out: a (static|zero|sweep|check|wind) run")
"""Of runs that a command has no use for: each call here is given all runs."""


def warnings_chunk(seed: int) -> pd.DataFrame:
    """Return one row for each command of the campaign of this number, with its warnings; the rigs take turns."""
    letter = RIGS[seed % len(RIGS)]
    geometry = other_rig(letter)
    rig = draw_rig(geometry, np.random.default_rng([seed, 5]))
    rig = replace(rig, damping_ratios=np.maximum(rig.damping_ratios, LEAST_DAMPING))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_geometry(folder / "geometry.yaml", geometry)
        runs = simulate_campaign(rig, short_campaign(letter), seed=seed).runs
        files = [folder / f"{run.name}.h5" for run in runs]
        for file, run in zip(files, runs, strict=True):
            write_run(file, run)
        rows = [_said(words, folder) for words in _calls(folder, [str(file) for file in files])]
    return pd.DataFrame(rows).assign(rig=letter, campaign=seed)


def _calls(folder: Path, files: list[str]) -> list[list[str]]:
    declared = ["-g", str(folder / "geometry.yaml")]
    calibration, model = str(folder / "calibration.h5"), str(folder / "model.h5")
    known = ["--calibration", calibration, "--model", model]
    return [
        ["check", *declared, *files],
        ["calibrate", *declared, *files, "-o", calibration],
        ["identify", *declared, *files, "-o", model],
        ["reduce", *known, *files, "-o", str(folder / "loads.csv")],
    ]


def _said(words: list[str], folder: Path) -> dict[str, object]:
    """Make a call; return its status, its warnings, and the flags of its loads that its rig does not explain."""
    done = CliRunner().invoke(balance, words)
    lines = [line for line in done.stderr.splitlines() if not OTHER_KIND.search(line)]
    warnings = [line.removeprefix(WARNING) for line in lines if line.startswith(WARNING)]
    said = "; ".join(warnings).replace(f"{folder}/", "")
    row = {"command": words[0], "status": done.exit_code, "warnings": len(warnings), "said": said}
    return {**row, **_flags(folder / "loads.csv")} if words[0] == "reduce" else row


def _flags(table: Path) -> dict[str, object]:
    """Return how many rows a table of loads has, how many with a flag, and which flags."""
    words = [set(flag.split(SEPARATOR)) - {UNTESTED, ""} for flag in pd.read_csv(table)["flag"].fillna("")]
    return {"rows": len(words), "flagged": sum(map(bool, words)), "flags": SEPARATOR.join(sorted(set().union(*words)))}


def warnings_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return campaigns, calls that did not end with 0, and warnings, by rig and command."""
    groups = rows.groupby(["rig", "command"], sort=False)
    return pd.DataFrame(
        {
            "campaigns": groups["campaign"].nunique(),
            "failed": groups["status"].apply(lambda status: int((status != 0).sum())),
            "warnings": groups["warnings"].sum(),
            "campaigns with a warning": groups["warnings"].apply(lambda count: int((count > 0).sum())),
            "rows": groups["rows"].sum(),
            "flagged": groups["flagged"].sum(),
            "said": groups["said"].apply(
                lambda said: "; ".join(dict.fromkeys(text for text in said.fillna("") if text))
            ),
        }
    ).reset_index()
