"""The sentence beside the verdict: true of what was found, whichever way the verdict came about."""

from dataclasses import replace

from balance_cli.diagnosis.result import PARTLY_EXPLAINED, LeftOut
from tests.support.diagnosis_content import diagnosis


def test_partly_explained_without_effects_does_not_speak_of_effects_found():
    limited = replace(diagnosis(), verdict=PARTLY_EXPLAINED, effects=(), notes=("zeros drift",))
    assert limited.meaning == "no candidate is significant, but a note says what no effect explains"
    excluded = replace(limited, left_out=LeftOut("channel", "z1.piezo", 1.0))
    assert excluded.meaning == "the model describes all data but those of channel z1.piezo, left out"


def test_partly_explained_by_effects_says_that_something_remains():
    found = replace(diagnosis(), verdict=PARTLY_EXPLAINED)
    assert found.effects
    assert found.meaning.startswith("the effects found are significant, but do not explain all")
