"""What the commands make of a blind campaign: one row of figures against the truth."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from studies.blind.campaign import EXCITATIONS, write_campaign
from studies.blind.hidden import LINEAR, NONLINEAR, OTHERS, Cause, Hidden, nothing
from studies.blind.records import COMPONENTS, true_rig
from studies.blind.rigs import draw_declared, draw_true
from studies.blind.unknown import UNKNOWN

Z_95 = 1.959963984540054


@dataclass(frozen=True)
class Outcome:
    """Exit status, processor time [s], peak memory [MB] and text of one command."""

    status: int
    cpu: float
    memory: float
    text: str


# Peak memory of a process includes that of the one which started it: a small process stands between.
LAUNCHER = """
import json, os, subprocess, sys
process = subprocess.Popen(sys.argv[2:], stdout=open("log.txt", "w"), stderr=subprocess.STDOUT)
_, status, usage = os.wait4(process.pid, 0)
status = os.waitstatus_to_exitcode(status)
json.dump([status, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024], open(sys.argv[1], "w"))
"""


def run_command(folder: Path, *arguments: str) -> Outcome:
    """Run `balance ARGUMENTS` in a folder."""
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "balance_cli", *arguments]
    launch = [sys.executable, "-c", LAUNCHER, "usage.json", *command]
    subprocess.run(launch, cwd=folder, env=environment, check=True)
    return Outcome(*json.loads((folder / "usage.json").read_text()), (folder / "log.txt").read_text())


def chain(folder: Path) -> dict[str, Outcome]:
    """Run calibrate to reduce on the run files of a folder, until one fails."""
    statics = sorted(path.name for path in folder.glob("static-*.h5"))
    swept = sorted(path.name for path in folder.glob("sweep-*.h5"))
    geometry, fitted = ("-g", "geometry.yaml"), (*statics, *swept)
    wind = ("zero.h5", "wind-1.h5", "wind-2.h5")
    held = ("--hold-out", "check-1.h5", "--hold-out", "check-2.h5")
    commands = {
        "calibrate": (*geometry, *statics, "-o", "cal.h5"),
        "sweep-tf": (*geometry, *swept, "-o", "tf.h5"),
        "identify": (*geometry, *fitted, "-o", "model.h5", "--json", "model.json"),
        "diagnose": ("model.h5", *fitted, *held, "-o", "diag.h5", "--model-out", "new.h5", "--json", "diag.json"),
        "reduce": (*wind, "--calibration", "cal.h5", "--model", "new.h5", "-o", "loads.csv", "--json", "loads.json"),
    }
    outcomes = {}
    for name, arguments in commands.items():
        outcomes[name] = run_command(folder, name, *arguments)
        (folder / f"{name}.txt").write_text(outcomes[name].text)
        if outcomes[name].status:
            break
    return outcomes


def load_errors(table: Path, truth: dict[str, NDArray[np.complex128]]) -> pd.DataFrame:
    """Deviation of each reduced harmonic from the truth in sigmas and in shares of the component's largest load."""
    rows = []
    with table.open() as stream:
        for row in csv.DictReader(stream):
            n, i = int(row["harmonic"]), COMPONENTS.index(row["component"])
            if row["run"] not in truth or n > 8:
                continue
            true = truth[row["run"]][n, i]
            largest = np.abs(truth[row["run"]][1:, i]).max()
            for name, value in (("cosine", true.real), ("sine", -true.imag))[: 2 if n else 1]:
                if not row[name]:
                    continue
                error, sigma = float(row[name]) - value, float(row[f"sigma_{name}"] or "nan")
                rows.append(
                    (row["flag"], n, error / sigma if sigma else np.nan, abs(error) / largest, row["component"])
                )
    return pd.DataFrame(rows, columns=["flag", "harmonic", "z", "share", "component"])


def _label(effect: dict[str, Any]) -> str:
    where = [*effect["where"], *([effect["parameters"]["side"]["value"]] if "side" in effect["parameters"] else [])]
    return effect["name"] + ("@" + ",".join(where) if where else "")


def label_is_right(label: str, effects: list[dict[str, Any]]) -> bool:
    """Whether an effect is named as it is, or stands among those that it cannot be told from."""
    for effect in effects:
        names = {_label(effect), *effect["indistinguishable_from"]}
        if label in names or any(name.split("@")[0] == label for name in names if "@" not in label):
            return True
    return False


def parameter_deviations(hidden: Hidden, effects: list[dict[str, Any]]) -> list[float]:
    """Deviations of the parameters of a rightly named effect in sigmas."""
    for effect in effects:
        if _label(effect) == hidden.label or ("@" not in hidden.label and effect["name"] == hidden.label):
            found = effect["parameters"]
            return [
                (found[name]["value"] - value) / found[name]["sigma"]
                for name, value in hidden.parameters.items()
                if name in found and found[name].get("sigma")
            ]
    return []


def blind_case(seed: int, causes: tuple[Cause, ...], folder: Path) -> dict[str, Any]:
    """Draw a rig, hide the causes, write the campaign, run the commands, and compare."""
    rng = np.random.default_rng([seed, 5])
    declared = draw_declared(np.random.default_rng([seed, 1]))
    truth = true_rig(draw_true(declared, np.random.default_rng([seed, 2])))
    hidden = []
    for cause in causes:
        hidden.append(cause(truth, rng))
        truth = hidden[-1].truth
    excitation = str(rng.choice(EXCITATIONS))
    start = time.time()
    harmonics = write_campaign(truth, declared, excitation, seed, folder)
    simulated = time.time() - start
    outcomes = chain(folder)
    row: dict[str, Any] = {
        "seed": seed,
        "cells": len(declared.stiffness),
        "channels": len(declared.channels),
        "mass": round(declared.mass),
        "lowest": round(float(declared.modes[0]), 1),
        "rotor": declared.rotor_speed,
        "rate": declared.sample_rate,
        "excitation": excitation,
        "causes": " + ".join(cause.__name__ for cause in causes),
        "hidden": " + ".join(one.label for one in hidden if one.label),
        "simulated_s": round(simulated, 1),
        "failed": next((name for name, outcome in outcomes.items() if outcome.status), ""),
        "cpu": round(sum(outcome.cpu for outcome in outcomes.values()), 1),
        "memory": round(max(outcome.memory for outcome in outcomes.values())),
    }
    if "diagnose" in outcomes and not outcomes["diagnose"].status:
        row |= _diagnosis(folder, hidden)
    if "reduce" in outcomes and not outcomes["reduce"].status:
        row |= _loads(folder, harmonics)
    return row


def _diagnosis(folder: Path, hidden: list[Hidden]) -> dict[str, Any]:
    summary = json.loads((folder / "diag.json").read_text())
    effects = summary["effects"]
    labels = [one.label for one in hidden if one.label]
    deviations = [z for one in hidden for z in parameter_deviations(one, effects)]
    return {
        "verdict": summary["verdict"],
        "found": " + ".join(_label(effect) for effect in effects),
        "right": sum(label_is_right(label, effects) for label in labels),
        "of": len(labels),
        "extra": max(0, len(effects) - len(labels)),
        "deviation": max((abs(z) for z in deviations), default=np.nan),
        "chi2_before": summary["chi2_per_dof"]["before"],
        "chi2_after": summary["chi2_per_dof"]["after"],
    }


def _loads(folder: Path, harmonics: dict[str, NDArray[np.complex128]]) -> dict[str, Any]:
    rows = load_errors(folder / "loads.csv", harmonics)
    good = rows[(rows["flag"] == "") & rows["z"].notna()]
    return {
        "rows": len(rows),
        "unflagged": len(good),
        "coverage": float(good["z"].abs().lt(Z_95).mean()) if len(good) else np.nan,
        "worst_z": float(good["z"].abs().max()) if len(good) else np.nan,
        "worst_share": float(good["share"].max()) if len(good) else np.nan,
        "coverage_all": float(rows["z"].abs().lt(Z_95).mean()),
        "worst_share_all": float(rows["share"].max()),
    }


KNOWN = (*LINEAR, *NONLINEAR)


def causes_of(seed: int) -> tuple[Cause, ...]:
    """The causes of a seed: of 30, four have nothing, sixteen one effect, four two or three, six another cause."""
    rng, kind = np.random.default_rng([seed, 9]), seed % 30
    if kind < 4:
        return (nothing,)
    if kind < 20:
        return (KNOWN[kind - 4],)
    if kind < 24:
        count = 2 + kind % 2
        return tuple(LINEAR[i] for i in rng.choice(len(LINEAR), count, replace=False))
    return (OTHERS[kind - 24],)


BLIND_KINDS: dict[str, Callable[[int], tuple[Cause, ...]]] = {
    "drawn": causes_of,
    "nothing": lambda seed: (nothing,),
    "unknown": lambda seed: (UNKNOWN[seed % len(UNKNOWN)],),
}
"""The causes of a seed in each kind of study."""


def blind_chunk(kind: str, seed: int) -> pd.DataFrame:
    """The row of one campaign of a kind, made and judged in a folder of its own."""
    with tempfile.TemporaryDirectory() as folder:
        return pd.DataFrame([blind_case(seed, BLIND_KINDS[kind](seed), Path(folder))])


def _kind_of(causes: str) -> str:
    """The kind of a campaign in the table, by the names of its causes."""
    if " + " in causes:
        return "several"
    known = {"nothing": "nothing", **{cause.__name__: "one effect" for cause in KNOWN}}
    return known.get(causes, "other cause")


def blind_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Figures by kind of campaign: nothing hidden, one effect, several, other causes."""
    kinds = rows["causes"].map(_kind_of)
    parts = []
    for kind in [name for name in ("nothing", "one effect", "several", "other cause") if (kinds == name).any()]:
        part = rows[kinds == kind]
        weight = part["unflagged"].fillna(0)
        parts.append(
            {
                "kind": kind,
                "campaigns": len(part),
                "failed": int(part["failed"].fillna("").ne("").sum()),
                "labels_right": f"{part['right'].sum():.0f} of {part['of'].sum():.0f}",
                "explained": int(part["verdict"].isin(["explained", "nothing missing"]).sum()),
                "unflagged": float(weight.sum() / part["rows"].sum()),
                "coverage": float((part["coverage"].fillna(0) * weight).sum() / max(weight.sum(), 1)),
                "worst_z": float(part["worst_z"].max()),
                "median_cpu": float(part["cpu"].median()),
                "largest_cpu": float(part["cpu"].max()),
                "largest_memory": float(part["memory"].max()),
            }
        )
    return pd.DataFrame(parts)
