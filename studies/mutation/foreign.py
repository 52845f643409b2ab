"""Example recordings in the formats that `balance import` reads, their maps, and changes to binary files."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.io import savemat, wavfile

from studies.mutation.text import change_lines

Array = NDArray[np.float64]

RATE = 400.0
SAMPLES = 1200
ROTOR = 10.0
NAMES = ("z1.strain", "z2.strain", "z1.piezo", "tacho")
UNITS = ("V", "V", "V", "V")

SIZES = (0, 1, 2, 7, 2**15, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1)
"""Values of a length, a count or an address that no file of this size can have, and those next to nothing."""


def recording() -> Array:
    """Return samples (SAMPLES, 4) of three channels and a tachometer with one pulse a revolution."""
    time = np.arange(SAMPLES) / RATE
    rng = np.random.default_rng(5)
    waves = np.column_stack([np.cos(2 * np.pi * ROTOR * k * time) for k in (1, 2, 3)])
    pulses = (np.mod(ROTOR * time + 0.05, 1.0) < 0.1) * 5.0
    return np.column_stack([waves + 0.01 * rng.standard_normal(waves.shape), pulses])


def write_recordings(folder: Path) -> None:
    """Write one recording and one map for each of FORMATS."""
    samples = recording()
    for name, (suffix, write, channels, keys) in FORMATS.items():
        write(folder / f"{name}{suffix}", samples)
        mapping: dict[str, Any] = {
            "format": "balance-import/1",
            "rig": "BENCH-2",
            "channels": {channels[k]: {"name": NAMES[k], "unit": "V"} for k in range(3)},
            "rotor": {"channel": channels[3]},
            **keys,
            "runs": [{"file": "*", "kind": "wind", "run": "wind"}],
        }
        (folder / f"{name}.map.yaml").write_text(yaml.safe_dump(mapping, sort_keys=False), encoding="utf-8")


# ---- writers ---------------------------------------------------------------------------------------------------------


def _write_csv(path: Path, samples: Array) -> None:
    head = [",".join(("time", *NAMES)), ",".join(("s", *UNITS))]
    rows = [",".join(f"{x:.6g}" for x in (k / RATE, *row)) for k, row in enumerate(samples)]
    path.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")


def _write_uff(path: Path, samples: Array, binary: bool) -> None:
    path.write_bytes(b"".join(_uff_dataset(name, samples[:, k], binary) for k, name in enumerate(NAMES)))


def _uff_dataset(name: str, values: Array, binary: bool) -> bytes:
    """Return dataset 58 or 58b of one channel: a time response in double precision."""
    code = f"    58b     1     2          11{8 * len(values):12d}     0     0           0           0"
    lines = [
        code if binary else "    58",
        *(name, "NONE", "18-Apr-16 13:49:58", "NONE", "NONE"),
        f"{1:5d}         0    0         0 {name[:10]:10s}         3   3 NONE               0   0",
        f"{4:10d}{len(values):10d}         1{0.0:13.5E}{1 / RATE:13.5E}{0.0:13.5E}",
        "        17    0    0    0 Time                 s",
        f"         0    0    0    0 {name:20s} V",
        "         0    0    0    0 NONE                 NONE",
        "         0    0    0    0 NONE                 NONE",
    ]
    head = b"    -1\n" + "".join(f"{line}\n" for line in lines).encode()
    if binary:
        return head + values.astype("<f8").tobytes() + b"\n    -1\n"
    numbers = [f"{value:20.12E}" for value in values]
    rows = ["".join(numbers[k : k + 4]) for k in range(0, len(numbers), 4)]
    return head + "".join(f"{row}\n" for row in rows).encode() + b"    -1\n"


def _write_mat5(path: Path, samples: Array) -> None:
    content = {"V": samples, "fs": RATE, "rec": {"force": samples[:, :1]}, "note": "wind"}
    savemat(path, content, format="5", do_compression=False)


def _write_mat73(path: Path, samples: Array) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in (("V", samples.T), ("fs", np.array([[RATE]])), ("rec/force", samples[:, :1].T)):
            file[name] = value
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
    content = path.read_bytes()
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + struct.pack("<HH", 512, 0x4D49)
    path.write_bytes(head + content[128:])


def _write_wav(path: Path, samples: Array) -> None:
    wavfile.write(path, int(RATE), (samples / 8.0 * 2**15).astype(np.int16))


def _write_tdms(path: Path, samples: Array) -> None:
    import nptdms

    properties = {"wf_increment": 1 / RATE, "unit_string": "V", "wf_start_time": np.datetime64("2026-01-01T00:00:00")}
    half = len(samples) // 2
    with nptdms.TdmsWriter(path) as writer:
        for part in (samples[:half], samples[half:]):
            channels = [nptdms.ChannelObject("daq", n, part[:, k], properties=properties) for k, n in enumerate(NAMES)]
            writer.write_segment(channels)


def _write_mdf(path: Path, samples: Array) -> None:
    import asammdf

    time = np.arange(len(samples)) / RATE
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(samples[:, k], time, name=n, unit="V") for k, n in enumerate(NAMES)])
        file.save(path, overwrite=True)


def _write_parquet(path: Path, samples: Array) -> None:
    import pandas as pd

    table = pd.DataFrame(samples, columns=[f"{name} [V]" for name in NAMES])
    table.insert(0, "time [s]", np.arange(len(samples)) / RATE)
    table.to_parquet(path, row_group_size=500)


NUMBERED = tuple(f"V[{k + 1}]" for k in range(4))
WAV_CHANNELS = tuple(f"channel {k + 1}" for k in range(4))
UFF_CHANNELS = tuple(f"{name}:3+Z" for name in NAMES)
Writer = Callable[[Path, Array], None]
FORMATS: dict[str, tuple[str, Writer, tuple[str, ...], dict[str, Any]]] = {
    "csv": (".csv", _write_csv, NAMES, {"time": "time"}),
    "uff58": (".uff", lambda path, samples: _write_uff(path, samples, False), UFF_CHANNELS, {}),
    "uff58b": (".uff", lambda path, samples: _write_uff(path, samples, True), UFF_CHANNELS, {}),
    "mat5": (".mat", _write_mat5, NUMBERED, {"sample_rate": RATE}),
    "mat73": (".mat", _write_mat73, NUMBERED, {"sample_rate": RATE}),
    "wav": (".wav", _write_wav, WAV_CHANNELS, {}),
    "tdms": (".tdms", _write_tdms, NAMES, {}),
    "mdf4": (".mf4", _write_mdf, NAMES, {}),
    "parquet": (".parquet", _write_parquet, NAMES, {"time": "time"}),
}
"""Suffix, writer, names of the channels as `balance import` sees them, and further keys of the map, of each format."""


# ---- changes ---------------------------------------------------------------------------------------------------------


def mutate_binary(data: bytes, rng: random.Random) -> bytes:
    """The file with lengths, counts and addresses replaced (half of the changes), or its bytes and blocks."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 3))):
        if changed:
            rng.choice(BINARY_CHANGES)(changed, rng)
    return bytes(changed)


def _described(data: bytearray, rng: random.Random) -> int:
    """Return a position that is likely to describe the samples: near the beginning, or the end, or next to text."""
    kind = rng.random()
    if kind < 0.4:
        return rng.randrange(min(len(data), 2000))
    if kind < 0.6:
        return len(data) - 1 - rng.randrange(min(len(data), 600))
    for _ in range(50):
        position = rng.randrange(len(data))
        if sum(32 <= byte < 127 for byte in data[position : position + 8]) >= 6:
            return min(max(position + rng.randint(-16, 24), 0), len(data) - 1)
    return rng.randrange(len(data))


def _size(data: bytearray, rng: random.Random) -> None:
    width = rng.choice((2, 4, 4, 8, 8))
    start = _described(data, rng) // 4 * 4
    order = rng.choice(("little", "little", "little", "big"))
    data[start : start + width] = (rng.choice(SIZES) % 2 ** (8 * width)).to_bytes(width, order)


def _nudge(data: bytearray, rng: random.Random) -> None:
    """Change a small number by one, or a large one by a factor."""
    start = _described(data, rng) // 4 * 4
    value = int.from_bytes(data[start : start + 4], "little")
    new = rng.choice((value + 1, value - 1, value * 2, value * 1000, value // 2)) % 2**32
    data[start : start + 4] = new.to_bytes(4, "little")


def _flip(data: bytearray, rng: random.Random) -> None:
    for _ in range(rng.randint(1, 8)):
        position = _described(data, rng)
        data[position] = rng.choice((data[position] ^ 1 << rng.randrange(8), 0, 255, rng.randrange(256)))


def _anywhere(data: bytearray, rng: random.Random) -> None:
    for _ in range(rng.randint(1, 8)):
        data[rng.randrange(len(data))] = rng.randrange(256)


def _cut(data: bytearray, rng: random.Random) -> None:
    start = rng.randrange(len(data))
    del data[start : start + rng.choice((1, 4, 8, 100, len(data)))]


def _copy(data: bytearray, rng: random.Random) -> None:
    source, target, length = rng.randrange(len(data)), rng.randrange(len(data)), rng.choice((8, 64, 512))
    data[target : target + length] = data[source : source + length]


def _insert(data: bytearray, rng: random.Random) -> None:
    start = rng.randrange(len(data))
    data[start:start] = rng.choice((b"\0", b"\xff" * 8, rng.randbytes(rng.randint(1, 100))))


def _append(data: bytearray, rng: random.Random) -> None:
    data += rng.choice((bytes(data), rng.randbytes(500), bytes(1000)))


BINARY_CHANGES: tuple[Callable[[bytearray, random.Random], None], ...] = (
    *(_size, _size, _size, _size, _nudge, _nudge, _flip, _flip, _anywhere, _cut, _copy, _insert, _append),
)

FIELDS = (b"0", b"-1", b"99999999", b"1e300", b"nan", b"inf", b"2147483648", b"1.5", b"", b"*****")


def mutate_universal(data: bytes, rng: random.Random) -> bytes:
    """A universal file with fields of its header lines replaced (half of the cases), its lines, or its bytes."""
    kind = rng.random()
    if kind < 0.3:
        return mutate_binary(data, rng)
    if kind < 0.5:
        return change_lines(data, rng)
    lines = data.split(b"\n")
    heads = [k for k, line in enumerate(lines) if line[:6] == b"    58"]
    for _ in range(rng.randint(1, 3)):
        row = rng.choice(heads) + rng.choice((0, 6, 7, 7, 7, 8, 9)) if heads else rng.randrange(len(lines))
        if row < len(lines):
            fields = lines[row].split(b" ")
            filled = [k for k, field in enumerate(fields) if field]
            if filled:
                place = rng.choice(filled)
                fields[place] = rng.choice(FIELDS).rjust(len(fields[place]))
                lines[row] = b" ".join(fields)
    return b"\n".join(lines)


WAV_HEADER = 44
"""Bytes before the samples: RIFF, format and length."""


def mutate_wav(data: bytes, rng: random.Random) -> bytes:
    """A WAV file with its header changed (half of the cases), or as any binary file: most bytes are samples."""
    if rng.random() < 0.5:
        return mutate_binary(data, rng)
    return mutate_binary(data[:WAV_HEADER], rng) + data[WAV_HEADER:]
