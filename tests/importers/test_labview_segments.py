"""Files of LabVIEW with a head before each segment: one record where the segments continue each other."""

import numpy as np
import pytest

from balance_cli.importers import open_foreign
from balance_cli.io.errors import UserError

ROWS, SEGMENTS, STEP = 20, 4, 0.002
X = np.round(np.random.default_rng(7).uniform(-1, 1, SEGMENTS * ROWS), 6)


def segment(k, begin, first_time, names="Force\tAcc", decimal=".", step=STEP):
    head = [("Channels", "2"), ("Samples", f"{ROWS}\t{ROWS}"), ("Date", "2015/09/23\t2015/09/23")]
    head += [("Time", f"23:59:{begin:.6f}\t23:59:{begin:.6f}"), ("Y_Unit_Label", "N\tg"), ("X0", "0.0E+0\t0.0E+0")]
    head += [("Delta_X", f"{step:.6f}\t{step:.6f}")]
    text = "".join(f"{key}\t{cells}\t\n" for key, cells in head) + f"***End_of_Header***\t\nX_Value\t{names}\tComment\n"
    for row in range(ROWS):
        time = "" if first_time is None else f"{first_time + row * STEP:.6f}"
        text += f"{time}\t{X[k * ROWS + row]:.6f}\t{-X[k * ROWS + row]:.6f}\n"
    return text.replace(".", decimal) + "\n"


def write(path, times="anew", late=0.0, **changes):
    """Segments whose times begin anew, go on, or are not written; the last one may be late, or otherwise different."""
    text = "LabVIEW Measurement\t\nSeparator\tTab\nMulti_Headings\tYes\n***End_of_Header***\t\n\t\n"
    for k in range(SEGMENTS):
        is_last = k == SEGMENTS - 1
        elapsed = k * ROWS * STEP + (late if is_last else 0.0)
        first = {"anew": 0.0, "on": elapsed, "none": None}[times]
        begin = 50.0 if times == "on" and not late else 50.0 + elapsed
        text += segment(
            k, begin, first, **(changes if is_last else {key: changes[key] for key in changes if key == "decimal"})
        )
    path.write_text(text)
    return path


@pytest.mark.parametrize("times", ["anew", "on", "none"])
@pytest.mark.parametrize("decimal", [".", ","])
def test_segments_that_continue_each_other_are_one_record(tmp_path, times, decimal):
    file = open_foreign(write(tmp_path / "a.lvm", times, decimal=decimal))
    (group,) = file.groups
    columns = [group.names.index(name) for name in ("Force", "Acc")]
    np.testing.assert_array_equal(group.read(columns, 0, group.samples), np.column_stack([X, -X]))
    assert file.notes == ("4 segments continue each other, and are one record",)
    assert file.scalars == {"sample_rate": 500.0}
    if times != "none":
        written = group.read([group.names.index("X_Value")], 0, group.samples)[:, 0]
        np.testing.assert_allclose(written, STEP * np.arange(len(X)), atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"late": 0.3}, "begins 0.34 s after the segment before, which lasts 0.04 s"),
        ({"late": 0.3, "times": "none"}, "begins 0.34 s after the segment before"),
        ({"late": 0.3, "times": "on"}, "begins 0.34 s after the segment before"),
        ({"names": "Force\tTorque"}, "has other channels, or another rate"),
        ({"step": 0.001}, "has other channels, or another rate"),
    ],
)
def test_segments_of_different_records_are_refused_with_the_row(tmp_path, changes, fault):
    with pytest.raises(UserError, match=fault) as caught:
        open_foreign(write(tmp_path / "a.lvm", **changes))
    assert caught.value.place == "row 105" and "Save each segment" in str(caught.value.remedy)
