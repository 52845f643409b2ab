"""One command that is ended at a random moment, as the study of interruptions does it."""

import os

import numpy as np
import pytest

from studies.interruptions import trials
from studies.interruptions.calls import GEOMETRY, Call, is_whole

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")


def test_a_command_that_is_ended_says_so_and_the_next_call_finds_nothing_of_it(tmp_path, monkeypatch):
    monkeypatch.setattr(trials, "AFTERMATH", 0.0)
    call = Call("modes", ("-g", GEOMETRY, "--json", "OUT/m.json"), ("m.json",))
    reference = trials.undisturbed(call, tmp_path / "alone" / "out")
    row = trials.interrupted_call(call, "SIGTERM", False, reference, np.random.default_rng(1), tmp_path / "trial")
    assert row["status right"] and row["one line"] and row["whole"] and row["next call right"], row
    assert row["left after"] == ""


def test_outputs_of_two_calls_are_not_whole():
    old, new = {"a": "0", "b": "0"}, {"a": "1", "b": "1"}
    assert is_whole(old, old, new) and is_whole(new, old, new)
    assert not is_whole({"a": "1", "b": "0"}, old, new) and not is_whole({"a": "1"}, old, new)
