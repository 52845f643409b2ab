"""Reading of long records: 12 channels at 51.2 kHz, each format against the plain library that wrote or reads it.

`python benchmarks/import_formats.py [SECONDS [FORMAT...]]` prints a table for records of so many seconds (60).
Times are those of the processor, so that other work on the machine does not count.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import scipy.io
from scipy.io import wavfile

from balance_cli.importers import open_foreign

CHANNELS, RATE = 12, 51200
BLOCK = 131072
"""Rows read at a time, as the command does for 12 channels."""

Reader = Callable[[Path], object]


def noise_block(rows: int, number: int) -> np.ndarray:
    """Samples (rows, CHANNELS) of noise in single precision."""
    return np.random.default_rng(number).standard_normal((rows, CHANNELS), np.float32)


def write_tdms(path: Path, data: np.ndarray) -> Reader:
    import nptdms

    properties = {"wf_increment": 1 / RATE, "unit_string": "V"}
    with nptdms.TdmsWriter(path) as writer:
        for start in range(0, len(data), RATE):
            part = data[start : start + RATE]
            writer.write_segment(
                [nptdms.ChannelObject("g", f"c{k}", part[:, k].copy(), properties=properties) for k in range(CHANNELS)]
            )
    return lambda path: [channel[:] for channel in nptdms.TdmsFile(path)["g"].channels()]


def write_mdf(path: Path, data: np.ndarray) -> Reader:
    import asammdf

    stamps = np.arange(len(data)) / RATE
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(data[:, k].copy(), stamps, name=f"c{k}", unit="V") for k in range(CHANNELS)])
        file.save(path.with_suffix(".mf4"))
    path.with_suffix(".mf4").rename(path)

    def read(path: Path) -> object:
        with asammdf.MDF(path) as file:
            return [file.get(f"c{k}").samples for k in range(CHANNELS)]

    return read


def write_mat(path: Path, data: np.ndarray) -> Reader:
    scipy.io.savemat(path, {f"c{k}": data[:, k : k + 1] for k in range(CHANNELS)}, appendmat=False)
    return lambda path: scipy.io.loadmat(path)


def write_hdf5(path: Path, data: np.ndarray) -> Reader:
    with h5py.File(path, "w") as file:
        file.create_dataset("data", data=data, chunks=(4096, CHANNELS))

    def read(path: Path) -> object:
        with h5py.File(path) as file:
            return file["data"][:]

    return read


def write_matlab_73(path: Path, data: np.ndarray) -> Reader:
    """As MATLAB saves vectors with `-v7.3`: a dataset each, compressed, behind a header block of 512 bytes."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for k in range(CHANNELS):
            file.create_dataset(f"c{k}", data=data[None, :, k], chunks=(1, 65536), compression=3)
            file[f"c{k}"].attrs["MATLAB_class"] = np.bytes_("single")

    def read(path: Path) -> object:
        with h5py.File(path) as file:
            return [file[f"c{k}"][0] for k in range(CHANNELS)]

    return read


def write_wav(path: Path, data: np.ndarray) -> Reader:
    wavfile.write(path, RATE, (data * 4000).astype(np.int16))
    return lambda path: wavfile.read(path)[1].astype(np.float64)


def write_parquet(path: Path, data: np.ndarray) -> Reader:
    table = pd.DataFrame({f"c{k}": data[:, k] for k in range(CHANNELS)})
    table.to_parquet(path, row_group_size=BLOCK)
    return lambda path: pd.read_parquet(path)


def write_csv(path: Path, data: np.ndarray) -> Reader:
    head = ",".join(f"c{k} [V]" for k in range(CHANNELS))
    lines = [",".join(map("{:.6g}".format, row)) for row in data[:20000].tolist()]
    with path.open("w", encoding="utf-8") as file:
        file.write(head + "\n")
        for start in range(0, len(data), len(lines)):
            file.write("\n".join(lines[: len(data) - start]) + "\n")
    return lambda path: pd.read_csv(path)


def write_uff(path: Path, data: np.ndarray) -> Reader:
    import pyuff

    with path.open("wb") as file:
        for k in range(CHANNELS):
            size = 4 * len(data)
            lines = [
                "    -1",
                f"    58b     1     2          11{size:12d}     0     0           0           0",
                *("title", "NONE", "18-Apr-16 13:49:58", "NONE", "NONE"),
                f"    1         0    0         0 c{k:<9d}         0   0 NONE               0   0",
                f"         2{len(data):10d}         1  0.00000E+00  1.95313E-05  0.00000E+00",
                "        17    0    0    0 Time                 s",
                "         0    0    0    0 Voltage              V",
                *("         0    0    0    0 NONE                 NONE",) * 2,
            ]
            file.write(b"".join(line.ljust(80).encode() + b"\r\n" for line in lines))
            file.write(data[:, k].astype("<f4").tobytes() + b"\r\n    -1\r\n")
    link = path.with_suffix(".uff")
    path.rename(link)
    path.symlink_to(link)
    return lambda path: pyuff.UFF(str(link)).read_sets()


FORMATS = {
    "UFF 58b": write_uff,
    "TDMS": write_tdms,
    "MDF4": write_mdf,
    "MAT 5": write_mat,
    "MAT 7.3": write_matlab_73,
    "HDF5": write_hdf5,
    "WAV, 16 bit": write_wav,
    "Parquet": write_parquet,
    "CSV": write_csv,
}


def read_in_blocks(path: Path) -> int:
    """Read all samples as the command does; returns their number."""
    file, count = open_foreign(path), 0
    longest = max(group.samples for group in file.groups)
    for start in range(0, longest, BLOCK):
        for group in file.groups:
            columns = range(len(group.channels))
            count += group.read(columns, start, min(start + BLOCK, group.samples)).size
    return count


def timed(function: Callable[[], object]) -> float:
    """Seconds of the processor in a call."""
    start = time.process_time()
    function()
    return time.process_time() - start


def main() -> None:
    """Print the table."""
    seconds = int(sys.argv[1]) if len(sys.argv) > 1 else 60
    data = np.concatenate([noise_block(RATE, k) for k in range(seconds)])
    print("| format | file [MB] | plain library [s] | import [s] | memory of the import [MB] |\n|---|---|---|---|---|")
    for name, write in ((name, FORMATS[name]) for name in sys.argv[2:] or FORMATS):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "record"
            plain = write(path, data)
            open_foreign(path)  # packages are loaded
            ours, memory = timed(lambda path=path: read_in_blocks(path)), peak_memory(path)
            theirs = timed(lambda path=path, plain=plain: plain(path))
            print(
                f"| {name} | {path.stat().st_size / 1e6:.0f} | {theirs:.2f} | {ours:.2f} | {memory:.0f} |", flush=True
            )


def peak_memory(path: Path) -> float:
    """Growth of memory [MB] of a fresh process while it reads the file in blocks."""
    import subprocess

    code = (
        "import re, sys; from benchmarks.import_formats import read_in_blocks, Path; from balance_cli.importers import "
        "open_foreign; import nptdms, asammdf, pyarrow.parquet, pandas\n"
        "def peak(): return int(re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1])\n"
        "before = peak(); read_in_blocks(Path(sys.argv[1])); print((peak() - before) / 1e3)"
    )
    root = Path(__file__).parents[1]
    return float(
        subprocess.run([sys.executable, "-c", code, str(path)], cwd=root, capture_output=True, check=True).stdout
    )


if __name__ == "__main__":
    main()
