"""Clocks that a head states for each column: those of columns without samples do not count."""

import numpy as np
import pytest

from balance_cli.importers import open_foreign
from balance_cli.io.errors import UserError

COUNT = 40
X = np.round(np.random.default_rng(3).uniform(-1, 1, COUNT), 6)


def labview(steps, cells, x_columns="One", comment=""):
    """A file of LabVIEW: step of each column, and the cells of row k behind its time."""
    names = [f"Dev/Ai{k}" for k in range(len(steps))]
    counts = ["0" if step == "1.000000" else "100" for step in steps]
    head = f"LabVIEW Measurement\nSeparator\tTab\nX_Columns\t{x_columns}\n***End_of_Header***\n\n"
    head += "\t".join(["Samples", *counts]) + "\n" + "\t".join(["X0", *["0.0E+0"] * len(steps)]) + "\n"
    head += "\t".join(["Delta_X", *steps]) + "\n***End_of_Header***\n"
    head += "\t".join(["X_Value", *names, "Comment"]) + "\n"
    time = "{:.6f}" if x_columns == "One" else ""
    return head + "".join("\t".join([time.format(k / 500), *cells(k)]) + comment + "\n" for k in range(COUNT))


@pytest.mark.parametrize("x_columns", ["One", "No"])
def test_step_of_a_channel_without_samples_is_not_that_of_the_others(tmp_path, x_columns):
    path = tmp_path / "a.lvm"
    text = labview(["0.002000", "1.000000", "0.002000"], lambda k: [f"{X[k]}", "", f"{-X[k]}"], x_columns)
    path.write_text(text)
    file = open_foreign(path)
    group = next(group for group in file.groups if "Dev/Ai0" in group.names)
    assert file.scalars == {"sample_rate": 500.0}
    columns = [group.names.index(name) for name in ("Dev/Ai0", "Dev/Ai2")]
    np.testing.assert_array_equal(group.read(columns, 0, COUNT), np.column_stack([X, -X]))


def test_different_steps_of_channels_with_samples_are_refused(tmp_path):
    path = tmp_path / "a.lvm"
    path.write_text(labview(["0.002000", "1.000000"], lambda k: [f"{X[k]}", f"{k}"]))
    with pytest.raises(UserError, match=r"`Delta_X` of 0.002000 and 1.000000"):
        open_foreign(path)


def test_clocks_beside_their_columns_all_count(tmp_path):
    """As imc writes them, the key stands above the first column."""
    path = tmp_path / "a.txt"
    rows = "".join(f"{x}\t{-x}\n" for x in X)
    path.write_text("Name:\tA\tB\nUnit:\tN\tN\ndx:\t0.001\t0.002\n" + rows)
    with pytest.raises(UserError, match=r"`dx:` of 0.001 and 0.002"):
        open_foreign(path)
