"""Frequency responses as other programs write them: universal files by pyuff, MAT files by SciPy, tables of text."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from balance_cli.campaign.rig.components import COMPONENTS

AVERAGES = 50
SIGMA = 2e-3
"""Standard deviation of a response over the rms of its channel, in the mean over the loads."""


def noisy_responses(T, seed=1):
    """Responses (k, c, u) with noise of SIGMA of each channel's rms, and the coherence that belongs to it."""
    rng = np.random.default_rng(seed)
    sigma = SIGMA * np.mean(np.sqrt(np.mean(np.abs(T) ** 2, axis=0)), axis=1, keepdims=True)
    noise = (rng.standard_normal(T.shape) + 1j * rng.standard_normal(T.shape)) * sigma / np.sqrt(2.0)
    power = np.abs(T) ** 2
    return T + noise, power / (power + sigma**2 * (AVERAGES - 1))


def write_map(path, rig, **entries):
    """A map of the channels by their own names."""
    path.write_text(yaml.safe_dump({"format": "balance-frf/1", "rig": rig, **entries}))
    return path


def directions(component):
    """The direction code of a universal file for a component."""
    return COMPONENTS.index(component) + 1


def write_uff(
    path, names, components, frequency, values, coherence=None, quantity=(0, 13), units=("V", "N"), signs=None
):
    """Functions of type 4 (and 6) by pyuff: channels are nodes 11, 12 ..., the hub is node 1."""
    pyuff = pytest.importorskip("pyuff")
    sets = []
    for j, component in enumerate(components):
        for i, name in enumerate(names):
            kinds = [(4, values[:, i, j])] + ([] if coherence is None else [(6, coherence[:, i, j])])
            for kind, data in kinds:
                sets.append(
                    {
                        "type": 58,
                        "binary": 0,
                        "func_type": kind,
                        "rsp_ent_name": name[:10],
                        "rsp_node": 11 + i,
                        "rsp_dir": 3,
                        "ref_ent_name": "hub",
                        "ref_node": 1,
                        "ref_dir": (signs or {}).get(component, 1) * directions(component),
                        "abscissa_spec_data_type": 18,
                        "abscissa_spacing": 1,
                        "ordinate_spec_data_type": quantity[0] if kind == 4 else 0,
                        "ordinate_axis_units_lab": units[0] if kind == 4 else "NONE",
                        "orddenom_spec_data_type": quantity[1] if kind == 4 else 0,
                        "orddenom_axis_units_lab": units[1] + (" m" if component.startswith("M") else ""),
                        "ord_data_type": 6 if kind == 4 else 4,
                        "data": data,
                        "x": frequency,
                    }
                )
    path = Path(path)
    path.unlink(missing_ok=True)
    pyuff.UFF(str(path)).write_sets(sets, "overwrite")
    return path


def uff_map(path, geometry, **entries):
    """The map of a file of `write_uff`."""
    names = geometry.channel_names
    axes = ("X", "Y", "Z", "RX", "RY", "RZ")
    references = {f"1+{axis}": name for axis, name in zip(axes, COMPONENTS, strict=True)}
    entries = {"references": references, **entries}
    return write_map(path, geometry.rig, responses={f"{11 + i}+Z": name for i, name in enumerate(names)}, **entries)


def write_binary_uff(path, written, functions):
    """Write the datasets 58 of a `written` file as 58b: eleven lines of text, then the complex `functions`.

    (pyuff loses the head of the second binary set that it writes to a file.)
    """
    parts = []
    for dataset, values in zip(Path(written).read_text().split("    -1\n    58")[1:], functions, strict=True):
        head = "".join(dataset.splitlines(keepends=True)[1:12])
        data = np.asarray(values, "<c16").tobytes()
        kind = f"{'58b':>6}{1:6d}{2:6d}{11:12d}{len(data):12d}{0:6d}{0:6d}{0:12d}{0:12d}"
        parts.append(f"    -1\n{kind}\n{head}".encode() + data + b"    -1\n")
    path.write_bytes(b"".join(parts))
    return path
