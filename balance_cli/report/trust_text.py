"""Trust in a load in one phrase, from the flags of its row."""

from __future__ import annotations

from balance_cli.reduction.flags import (
    EXTRAPOLATED,
    NOT_STEADY,
    SEPARATOR,
    TRUSTED,
    UNMODELLED_LINE,
    UNTESTED,
    trust_word,
)

DOUBTS = (NOT_STEADY, EXTRAPOLATED, UNMODELLED_LINE)
NOT_TESTED = "not tested"


def trust_text(flags: str) -> str:
    """Return one phrase of trust for the flags of a row: the worst of them."""
    word = trust_word(flags)
    given = flags.split(SEPARATOR)
    if word == "doubtful":
        return next((doubt for doubt in DOUBTS if doubt in given), word)
    return {TRUSTED: "tested and good", UNTESTED: NOT_TESTED}.get(word, word)
