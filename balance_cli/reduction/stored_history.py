"""Load histories as results: hub loads of a run over time, read from the file that a reduction wrote."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.io.errors import UserError
from balance_cli.io.formats import HISTORY_FORMAT
from balance_cli.io.hdf5_links import refuse_other_files
from balance_cli.io.hdf5_tree import require_stored_values
from balance_cli.io.reader_process import read_in_child
from balance_cli.io.result_view import ResultView
from balance_cli.io.sniff import attribute_text

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

DATASETS = ("time", "loads", "sigma")


@dataclass(frozen=True, repr=False)
class StoredHistory(ResultView):
    """Hub loads of one run: `time` (n,) [s from the first sample], `loads` and `sigma` (n, m) [N, N m].

    `components` (m,) are those that were determined. Without `has_mean` the loads count from a mean that was not
    measured.
    """

    run: str
    components: tuple[str, ...]
    time: Array
    loads: Array
    sigma: Array
    has_mean: bool = True

    def summary_lines(self) -> Iterator[str]:
        """Run, length, components."""
        yield f"History of the hub loads of run {self.run}: {len(self.time)} samples, {' '.join(self.components)}"

    def to_frame(self) -> pd.DataFrame:
        """One row for each sample: `time_s`, each component, and its sigma as `Fz_sigma`."""
        import pandas as pd

        columns = {"time_s": self.time}
        for k, name in enumerate(self.components):
            columns |= {name: self.loads[:, k], f"{name}_sigma": self.sigma[:, k]}
        return pd.DataFrame(columns)


@read_in_child
def read_history(path: Path) -> StoredHistory:
    """The history in a file of `reduce --history`. Raises UserError where it is damaged."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            for name in DATASETS:
                refuse_other_files(file, name)
                require_stored_values(file[name])
            time, loads, sigma = (np.asarray(file[name][()], float) for name in DATASETS)
            run = attribute_text(file.attrs.get("run")) or path.stem
            has_mean = "mean" not in file.attrs
    except UserError as error:
        raise error.with_location(file=str(path)) from error
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError) as error:
        fault = f"is no sound `{HISTORY_FORMAT}` file ({error})"
        raise UserError(fault, str(path), remedy="Reduce the run again with --history") from error
    if time.ndim != 1 or loads.shape != (len(time), len(COMPONENTS)) or sigma.shape != loads.shape:
        fault = f"`loads` {loads.shape} and `sigma` {sigma.shape} do not fit `time` {time.shape}"
        raise UserError(fault, str(path), remedy="Reduce the run again with --history")
    columns = [k for k in range(len(COMPONENTS)) if np.isfinite(loads[:, k]).any()]
    names = tuple(COMPONENTS[k] for k in columns)
    return StoredHistory(run, names, time, loads[:, columns], sigma[:, columns], has_mean)
