"""Labels of the load points of a static run: the load series of each row, and what kind of point it is.

Both datasets, `series` and `point`, are optional. Without them the load series are found from the loads.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from balance_cli.io.errors import UserError

POINT_KINDS = ("tare", "load", "repeat", "check")
"""Kinds of load points: unloaded, loaded, an earlier load once more, and a load that is kept out of every fit."""
MOST_LABELS = 10_000_000
"""Rows of a static run with labels; no calibration has so many."""


@dataclass(frozen=True)
class LabelDataset:
    """A dataset of labels (n,): its shape, numpy's code of its type, and its values as text.

    `labels` is None where the shape, the type or the size is not sound.
    """

    shape: tuple[int, ...]
    kind: str
    labels: tuple[str, ...] | None


def label_texts(values: Any) -> tuple[str, ...] | None:
    """Labels as text, from an array of text, of integers, or of floats that are integers; None for anything else."""
    array = np.asarray(values)
    if array.ndim != 1:
        return None
    if array.dtype.kind in "iuf":
        if array.dtype.kind == "f" and not (np.isfinite(array).all() and np.array_equal(array, np.round(array))):
            return None
        return tuple(str(int(value)) for value in array.tolist())
    if array.dtype.kind not in "OSU":
        return None
    texts = [value.decode("utf-8", "replace") if isinstance(value, bytes) else value for value in array.tolist()]
    return tuple(text.strip() for text in texts) if all(isinstance(text, str) for text in texts) else None


def label_faults(kind: object, name: str, dataset: LabelDataset | None, rows: int) -> Iterator[UserError]:
    """Yield the faults of the dataset `series` or `point` of a run of this kind, by its number of rows."""
    if dataset is None:
        return
    if kind != "static":
        yield UserError(f"a `{kind}` run has no `{name}`", place=name, remedy="Remove the dataset, or correct `kind`")
        return
    if dataset.labels is None:
        fault = f"has the shape {dataset.shape}" if len(dataset.shape) != 1 else "holds neither text nor integers"
        yield UserError(fault, place=name, remedy="It should be one label for each load point")
        return
    if len(dataset.labels) != rows:
        fault = f"{len(dataset.labels)} labels, but {rows} rows of channels"
        yield UserError(fault, place=name, remedy="Both should have one row for each load point")
    yield from _label_value_faults(name, dataset.labels)


def _label_value_faults(name: str, labels: Sequence[str]) -> Iterator[UserError]:
    empty = next((row for row, label in enumerate(labels) if not label), None)
    if empty is not None:
        yield UserError(f"the label of row {empty + 1} is empty", place=name, remedy="Give every row its label")
    elif name == "point":
        unknown = next((row for row, label in enumerate(labels) if label not in POINT_KINDS), None)
        if unknown is not None:
            fault = f"row {unknown + 1} is of the kind `{labels[unknown]}`"
            yield UserError(fault, place=name, remedy=f"It should be one of {', '.join(POINT_KINDS)}")
