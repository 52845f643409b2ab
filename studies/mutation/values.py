"""Values that files should not contain, and often do."""

from __future__ import annotations

import random
from typing import Any

import h5py
import numpy as np

NUMBERS = (0, -1, 1, 2, 3.7, -0.0, 1e-300, 5e-324, 1e-9, 1e9, 1e30, 1e300, -1e300, 2**31, 2**63, 10**30)
SPECIAL = (float("nan"), float("inf"), float("-inf"))
TEXTS = ("", " ", "x", "nan", "1e3", "1,5", "../x", "/", "a\nb", "a\x00b", "=1+1", "$\\foo{$", "<b>", "日本", "n" * 300)


def any_number(rng: random.Random) -> Any:
    return rng.choice((*NUMBERS, *SPECIAL))


def any_plain_value(rng: random.Random) -> Any:
    """A value that YAML and JSON can hold."""
    kinds = (
        lambda: any_number(rng),
        lambda: rng.choice(TEXTS),
        lambda: rng.choice((True, False, None)),
        lambda: [],
        lambda: {},
        lambda: [any_number(rng) for _ in range(rng.randint(1, 7))],
        lambda: {rng.choice(TEXTS): any_number(rng)},
        lambda: [[any_number(rng)]],
    )
    return rng.choice(kinds)()


def any_attribute(rng: random.Random) -> Any:
    """A value that an HDF5 attribute can hold."""
    kinds = (
        lambda: float(any_number(rng)),
        lambda: rng.choice([text for text in TEXTS if "\x00" not in text]),
        lambda: np.bytes_(b"caf\xe9"),
        lambda: h5py.Empty("f8"),
        lambda: np.zeros(rng.choice((0, 1, 2, 2000))),
        lambda: np.full((2, 3), np.nan),
        lambda: np.array(["a", "b"], h5py.string_dtype()),
        lambda: np.int64(-(2**63)),
        lambda: np.bool_(True),
        lambda: 1 + 2j,
        lambda: np.zeros(2, [("a", "f4"), ("b", "i4")]),
    )
    return rng.choice(kinds)()
