"""A name in the map that several channels of a file have: refused with the names that tell them apart."""

import numpy as np
import pytest
import yaml

from balance_cli.campaign.recording.import_map import ImportMap
from balance_cli.campaign.recording.import_map_file import declared_runs
from balance_cli.importers import open_foreign
from balance_cli.io.errors import UserError
from balance_cli.steps.import_runs import import_run
from balance_cli.steps.import_sketch import sketch_map

X = np.random.default_rng(2).uniform(-1, 1, (50, 2))


def table(path):
    rows = "".join(f"{k / 1000:.3f},{a:.6f},{b:.6f}\n" for k, (a, b) in enumerate(X))
    path.write_text("t [s],F1 [V],F1 [V]\n" + rows)


def groups_of_mdf(path):
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(version="4.10") as file:
        for column in X.T:
            file.append([asammdf.Signal(np.round(column, 6), np.arange(50) / 1000.0, name="F1", unit="V")])
        file.save(path.with_suffix(".mf4"))
    path.with_suffix(".mf4").rename(path)


def imported(path, names, **keys):
    channels = {name: {"name": f"z{k + 1}", "unit": "V"} for k, name in enumerate(names)}
    keys |= {"time": "t"} if b"t [s]" in path.read_bytes()[:100] else {}
    runs = [{"file": "*", "kind": "zero", "run": "zero-1"}]
    mapping = ImportMap.model_validate(
        {"format": "balance-import/1", "rig": "r", "runs": runs, "channels": channels, **keys}
    )
    run = import_run(declared_runs(mapping, [path], "map")[0], [open_foreign(path)]).run
    return np.concatenate([block.channels for block in run.blocks(20)])


@pytest.mark.parametrize(
    ("write", "places"),
    [
        (table, r"`F1 #1` \(channel 2 in V\), `F1 #2` \(channel 3 in V\)"),
        (groups_of_mdf, r"`F1 #1` \(group 1, channel 1 in V\), `F1 #2` \(group 2, channel 1 in V\)"),
    ],
)
def test_the_first_of_several_channels_of_one_name_is_not_taken_in_silence(tmp_path, write, places):
    path = tmp_path / "record"
    write(path)
    with pytest.raises(UserError, match="has 2 channels of this name: " + places):
        imported(path, ["F1"])
    expected = np.round(X, 6)
    assert np.array_equal(imported(path, ["F1 #1"]), expected[:, :1])
    assert np.array_equal(imported(path, ["F1 #2"]), expected[:, 1:])
    assert np.array_equal(imported(path, ["record/F1 #1"]), expected[:, :1])
    # A map that has both knows of them; sketches of version 0.1 wrote it so.
    assert np.array_equal(imported(path, ["F1", "F1 #2"]), expected)
    sketch = yaml.safe_load(sketch_map([open_foreign(path)], None))
    assert list(sketch["channels"]) == ["F1 #1", "F1 #2"]


def test_a_name_in_two_groups_of_tdms_is_refused_with_the_groups(tmp_path):
    nptdms = pytest.importorskip("nptdms")
    properties = {"wf_increment": 0.001, "unit_string": "V"}
    with nptdms.TdmsWriter(tmp_path / "record") as writer:
        writer.write_segment([nptdms.ChannelObject(group, "F1", X[:, k], properties) for k, group in enumerate("ab")])
    with pytest.raises(UserError, match="has 2 channels of this name: `a/F1`, `b/F1`"):
        imported(tmp_path / "record", ["F1"])
    assert np.array_equal(imported(tmp_path / "record", ["b/F1"]), X[:, 1:])


def test_names_that_the_file_numbers_itself_are_distinct(tmp_path):
    path = tmp_path / "record"
    table(path)
    path.write_text(path.read_text().replace("F1 [V],F1 [V]", "F1 [V],F1 #2 [V]"))
    assert np.array_equal(imported(path, ["F1"]), np.round(X[:, :1], 6))
