"""The readers of the program: an example file for each, how it is changed, and the calls that read it.

A new reader is one entry in READERS, and a line in `make_examples` where its example is not there yet.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import yaml
from click.testing import CliRunner

from balance_cli.cli import balance
from studies.mutation.foreign import FORMATS, mutate_binary, mutate_universal, mutate_wav, write_recordings
from studies.mutation.hdf5 import mutate_hdf5
from studies.mutation.text import mutate_table, mutate_yaml

Words = list[str | Path]

GEOMETRY = {
    "format": "balance-geometry/1",
    "name": "two-cells",
    "rig": "BENCH-2",
    "hub": [0.0, 0.0, 0.2],
    "bodies": [
        {"name": "plate", "mass": 25.0, "position": [0.0, 0.0, 0.0], "inertia": {"xx": 0.3, "yy": 0.3, "zz": 0.4}},
        {"name": "hub", "mass": 2.0, "position": [0.0, 0.0, 0.2], "inertia": {"xx": 0.01, "yy": 0.01, "zz": 0.01}},
    ],
    "cells": [
        {"name": "z1", "position": [0.2, 0.0, 0.0], "axis": [0, 0, 1], "stiffness": 2.0e5, "full_range": 500.0},
        {"name": "z2", "position": [-0.2, 0.0, 0.0], "axis": [0, 0, 1], "series": [4.0e5, 4.0e5], "full_range": 500.0},
    ],
    "channels": [
        {"name": "z1.strain", "cell": "z1", "sensitivity": 0.01},
        {"name": "z2.strain", "cell": "z2", "sensitivity": 0.01, "lowpass": 900.0, "range": 10.0},
        {"name": "z1.piezo", "cell": "z1", "sensitivity": 0.02, "time_constant": 3.0},
    ],
    "acquisition": {"filter": {"type": "butterworth", "order": 4, "cutoff": 120.0}},
    "damping_ratio": 0.02,
    "freedom": ["z", "theta"],
    "tolerances": {"stiffness": 0.05, "mass": 0.02, "damping_ratio": 0.5},
    "rotor": {"blades": 4, "speed": 10.0},
    "effects": [{"name": "time-delay", "where": ["z1.piezo"], "parameters": {"delay": 1.0e-4}}],
}
RATE = {"sample_rate": 400.0}
ROTOR = {"rotor_speed": 20.0, "duration": 8.0, **RATE}
PLAN: dict[str, list[dict[str, Any]]] = {
    "runs": [
        {"run": "static", "kind": "static", "largest": {"Fz": 300.0, "My": 20.0}, "steps": 3},
        {"run": "sweep", "kind": "sweep", "excited": ["Fz"], "level": [20.0], "period": 1.0, "periods": 5, **RATE},
        {"run": "tilt", "kind": "sweep", "excited": ["My"], "level": [3.0], "period": 1.0, "periods": 5, **RATE},
        {"run": "check", "kind": "check", **ROTOR, "harmonics": {"Fz": [50.0, 9.0]}},
        {"run": "wind", "kind": "wind", **ROTOR},
    ]
}
for _run in PLAN["runs"]:
    if _run["kind"] == "sweep":
        _run["band"] = [4.0, 100.0]


@dataclass(frozen=True)
class Reader:
    """A kind of file: the name of its example, how it is changed, and the calls that read it."""

    example: str
    mutate: Callable[[bytes, random.Random], bytes]
    calls: tuple[Callable[[Path, Path, Path], Words], ...]
    """Words of a call from the folder of the examples, the changed file and an empty folder for outputs."""


def make_examples(folder: Path) -> None:
    """Write the example of each reader to an empty folder."""
    (folder / "geometry.yaml").write_text(yaml.safe_dump(GEOMETRY, sort_keys=False), encoding="utf-8")
    (folder / "plan.yaml").write_text(yaml.safe_dump(PLAN, sort_keys=False), encoding="utf-8")
    g = ["-g", folder / "geometry.yaml"]
    _call("simulate", *g, "--plan", folder / "plan.yaml", "-o", folder / "runs")
    for run in (folder / "runs").glob("*.h5"):
        run.rename(folder / f"{run.stem}.run.h5")
    _call("calibrate", *g, folder / "static.run.h5", "-o", folder / "cal.h5", "--matrix", folder / "matrix.csv")
    sweeps = (folder / "sweep.run.h5", folder / "tilt.run.h5")
    _call("sweep-tf", *g, *sweeps, "-o", folder / "tf.h5")
    _call("identify", *g, *sweeps, "--method", "computed", "-o", folder / "model.h5")
    _call("reduce", *_response(folder), folder / "check.run.h5", "-o", folder / "loads.h5", "--history", folder)
    (folder / "check.h5").rename(folder / "history.h5")
    hold_out = ("--hold-out", folder / "check.run.h5")
    outputs = ("-o", folder / "diagnosis.h5", "--model-out", folder / "updated.h5")
    _call("diagnose", folder / "model.h5", *sweeps, *hold_out, *outputs)
    _call("reduce", *_response(folder), folder / "wind.run.h5", "-o", folder / "wind-loads.h5")
    _write_point_table(folder / "static.run.h5", folder / "points.csv")
    write_recordings(folder)


def _call(*words: str | Path) -> None:
    done = CliRunner().invoke(balance, [str(word) for word in words])
    if done.exit_code:
        raise RuntimeError(f"balance {words[0]}: {done.output}")


def _response(folder: Path) -> Words:
    return ["--calibration", folder / "cal.h5", "--model", folder / "model.h5"]


def _write_point_table(run: Path, table: Path) -> None:
    with h5py.File(run) as file:
        channels, loads = file["channels"][()], file["loads"][()]
        names = [str(name) for name in file["channels"].attrs["names"]]
    head = ["point", "Fz [N]", "My [N m]", *(f"{name} [V]" for name in names)]
    rows = [["load", a[2], a[4], *c] for a, c in zip(loads, channels, strict=True)]
    lines = [",".join(map(str, row)) for row in (head, *rows)]
    table.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _check(base: Path, bad: Path, out: Path) -> Words:
    return ["check", bad]


def _check_with_geometry(base: Path, bad: Path, out: Path) -> Words:
    return ["check", "-g", base / "geometry.yaml", bad]


def _reduce(*options: str) -> Callable[[Path, Path, Path], Words]:
    return lambda base, bad, out: ["reduce", *_response(base), *options, bad, "-o", out / "o.csv"]


def _calibrate(base: Path, bad: Path, out: Path) -> Words:
    return ["calibrate", "-g", base / "geometry.yaml", bad, "-o", out / "o.h5"]


def _report(base: Path, bad: Path, out: Path) -> Words:
    return ["report", bad, "-o", out / "o.html"]


def _export(suffix: str) -> Callable[[Path, Path, Path], Words]:
    return lambda base, bad, out: ["export", bad, "-o", out / f"o{suffix}"]


def _reduce_by(option: str) -> Callable[[Path, Path, Path], Words]:
    """Reduce the check run by a changed model or a changed transfer function."""
    return lambda base, bad, out: [
        *("reduce", "--calibration", base / "cal.h5", option, bad, base / "check.run.h5", "-o", out / "o.csv")
    ]


def _of_sweeps(command: str, *options: str) -> Callable[[Path, Path, Path], Words]:
    return lambda base, bad, out: [command, "-g", base / "geometry.yaml", *options, bad, "-o", out / "o.h5"]


def _import(name: str) -> tuple[Callable[[Path, Path, Path], Words], ...]:
    """Import a changed recording by its map, and print a map of it."""
    return (
        lambda base, bad, out: ["import", base / f"{name}.map.yaml", bad, "-o", out / "runs"],
        lambda base, bad, out: ["import", base / f"{name}.map.yaml", bad, "-o", out / "runs"],
        lambda base, bad, out: ["import", "--sketch", bad],
    )


MUTATIONS = {
    "csv": mutate_table,
    "uff58": mutate_universal,
    "uff58b": mutate_universal,
    "mat73": mutate_hdf5,
    "wav": mutate_wav,
}
"""How recordings are changed whose format is known; the others as binary files."""

READERS: dict[str, Reader] = {
    "geometry": Reader(
        "geometry.yaml",
        mutate_yaml,
        (
            _check,
            lambda base, bad, out: ["modes", "-g", bad],
            lambda base, bad, out: ["calibrate", "-g", bad, base / "static.run.h5", "-o", out / "o.h5"],
            lambda base, bad, out: ["sweep-tf", "-g", bad, base / "sweep.run.h5", "-o", out / "o.h5"],
        ),
    ),
    "plan": Reader(
        "plan.yaml",
        mutate_yaml,
        (lambda base, bad, out: ["simulate", "-g", base / "geometry.yaml", "--plan", bad, "-o", out / "runs"],),
    ),
    "static run": Reader("static.run.h5", mutate_hdf5, (_check, _check_with_geometry, _calibrate)),
    "sweep run": Reader(
        "sweep.run.h5",
        mutate_hdf5,
        (_check, _check_with_geometry, _of_sweeps("sweep-tf"), _of_sweeps("identify", "--method", "computed")),
    ),
    "check run": Reader("check.run.h5", mutate_hdf5, (_check, _reduce(), _reduce("--method", "kalman"))),
    "wind run": Reader("wind.run.h5", mutate_hdf5, (_check_with_geometry, _reduce())),
    "matrix": Reader(
        "matrix.csv",
        mutate_table,
        (
            _check_with_geometry,
            lambda base, bad, out: [*_calibrate(base, bad, out)[:3], "--from-matrix", bad, "-o", out / "o.h5"],
        ),
    ),
    "point table": Reader(
        "points.csv",
        mutate_table,
        (_calibrate, lambda base, bad, out: ["apply", base / "cal.h5", bad, "-o", out / "o.csv"]),
    ),
    "calibration": Reader(
        "cal.h5",
        mutate_hdf5,
        (
            _check,
            _report,
            lambda base, bad, out: [
                *("reduce", "--calibration", bad, "--model", base / "model.h5", base / "check.run.h5"),
                *("-o", out / "o.csv"),
            ],
        ),
    ),
    "transfer": Reader("tf.h5", mutate_hdf5, (_check, _report, _reduce_by("--transfer"), _export(".uff"))),
    "model": Reader("model.h5", mutate_hdf5, (_check, _report, _reduce_by("--model"), _export(".csv"))),
    "diagnosis": Reader("diagnosis.h5", mutate_hdf5, (_check, _report, _export(".csv"))),
    "loads": Reader(
        "loads.h5",
        mutate_hdf5,
        (
            _check,
            _report,
            _export(".mat"),
            lambda base, bad, out: ["merge", bad, base / "wind-loads.h5", "-o", out / "o.h5"],
            lambda base, bad, out: ["trend", bad, base / "wind-loads.h5", "-o", out / "o.csv"],
        ),
    ),
    "history": Reader("history.h5", mutate_hdf5, (_check, _export(".csv"), _export(".uff"))),
    "import map": Reader(
        "csv.map.yaml", mutate_yaml, (lambda base, bad, out: ["import", bad, base / "csv.csv", "-o", out / "runs"],)
    ),
    **{
        f"import {name}": Reader(f"{name}{suffix}", MUTATIONS.get(name, mutate_binary), _import(name))
        for name, (suffix, *_) in FORMATS.items()
    },
}
