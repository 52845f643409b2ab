"""A small share of the study of changed files: no internal error, no crash, no endless call, nothing left behind."""

import os

import pytest

from studies.mutation.outcomes import FAULTS, REFUSED, try_file
from studies.mutation.processes import import_program
from studies.mutation.readers import READERS

FILES = 6
"""Of each reader; `python -m studies.mutation` tries ten thousand."""

ONCE_FAULTY = {"check run": (5,), "history": (264,)}
"""Seeds of files that had made a fault: channels in whole volts, to which no filter is steady; a single time."""

pytestmark = pytest.mark.skipif(os.name != "posix", reason="processes of POSIX")


@pytest.fixture(scope="module", autouse=True)
def imported_program():
    import_program()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("reader", READERS)
def test_changed_files_are_read_or_refused(examples, tmp_path, reader):
    seeds = (*range(700, 700 + FILES), *ONCE_FAULTY.get(reader, ()))
    outcomes = [try_file(reader, examples.folder, tmp_path / "work", seed) for seed in seeds]
    assert [outcome for outcome in outcomes if outcome.kind in FAULTS] == []
    assert any(outcome.kind == REFUSED for outcome in outcomes)
