"""The study of changed files: the same seed changes a file in the same way, and in many ways."""

import random
from collections import Counter

import h5py
import numpy as np
import yaml

from studies.mutation.hdf5 import mutate_hdf5
from studies.mutation.outcomes import INTERNAL, READ, REFUSED, Outcome
from studies.mutation.readers import GEOMETRY
from studies.mutation.text import mutate_table, mutate_yaml


def changed(mutate, data, count=40):
    first = [mutate(data, random.Random(seed)) for seed in range(count)]
    assert first == [mutate(data, random.Random(seed)) for seed in range(count)]
    return Counter(item == data for item in first)[False]


def test_text_is_changed_by_its_seed():
    assert changed(mutate_yaml, yaml.safe_dump(GEOMETRY).encode()) >= 35
    assert changed(mutate_table, b"a,b,c\n" + b"1.5,2,x\n" * 20) >= 35


def test_hdf5_is_changed_by_its_seed(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.attrs["format"] = "x"
        table = file.create_dataset(
            "g/table", data=np.arange(600.0).reshape(200, 3), chunks=(50, 3), compression="gzip"
        )
        table.attrs["names"] = ["a", "b", "c"]
    assert changed(mutate_hdf5, path.read_bytes()) >= 35


def test_the_table_counts_outcomes():
    from studies.mutation.__main__ import outcome_table

    kinds = {"plan": [READ, REFUSED, REFUSED], "loads": [INTERNAL]}
    outcomes = [Outcome(name, i, kind, "", "") for name, items in kinds.items() for i, kind in enumerate(items)]
    table = outcome_table(outcomes).set_index("reader")
    assert table.loc["all", ["files", READ, REFUSED, INTERNAL]].tolist() == [4, 1, 2, 1]
