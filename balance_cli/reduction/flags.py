"""Flags of loads: why a row of a load table is not to be taken as it is. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Iterable

NO_ZERO = "no zero"
"""The mean counts from the reading of the unloaded rig during the calibration: no wind-off record was given."""
NOT_MEASURED = "not measured"
"""No channel that measures a mean is there."""
UNTESTED = "untested"
"""No more independent sensors than loads: nothing can contradict the load."""
REDUNDANCY = "redundancy"
"""The redundant channels contradict the load."""
EXTRAPOLATED = "extrapolated"
"""The mean load lies outside the calibrated range."""
NO_WEIGHT = "no weight"
"""The rig has another attitude than at its zero, and the change of weight in the load is not known."""
NO_TEMPERATURE = "no temperature"
"""The channels depend on temperature, and that of the run or of its zero is not known."""
NOT_STEADY = "not steady"
"""The load steps or drifts within the interval over which it was averaged."""
UNMODELLED_LINE = "unmodelled line"
"""The channels have a line beside the reduced harmonics."""
FILTER_CONTRADICTED = "filter contradicted"
"""The innovations of the filter are not of the size that it states, or not white."""
MODEL_CONTRADICTED = "model contradicted"
"""The response misses its own measured data by a share of the load that matters."""

UNRESOLVED = "not resolved"
"""The record is too short to resolve a mode of the balance, whose response is not one number within the bandwidth, or
the lines of a measured response are too far apart."""

FLAGS = (
    NO_ZERO,
    NOT_MEASURED,
    UNTESTED,
    REDUNDANCY,
    EXTRAPOLATED,
    NO_WEIGHT,
    NO_TEMPERATURE,
    NOT_STEADY,
    UNMODELLED_LINE,
    FILTER_CONTRADICTED,
    MODEL_CONTRADICTED,
    UNRESOLVED,
)
SEPARATOR = "; "


def join_flags(words: Iterable[str]) -> str:
    """Return the flags as one text in their fixed order, each once; empty words are left out."""
    given = {word for text in words for word in text.split(SEPARATOR) if word}
    return SEPARATOR.join(flag for flag in FLAGS if flag in given)


DOUBTFUL, TRUSTED = "doubtful", "good"
NOT_TESTED = "not tested"
NAMED_DOUBTS = (NOT_STEADY, EXTRAPOLATED, UNMODELLED_LINE, UNRESOLVED)
"""Flags that a phrase of trust names, the first of them that a row has."""
TRUST_WORDS = (
    ("contradicted", (REDUNDANCY, FILTER_CONTRADICTED, MODEL_CONTRADICTED)),
    (DOUBTFUL, (EXTRAPOLATED, NO_WEIGHT, NO_TEMPERATURE, NOT_STEADY, UNMODELLED_LINE, UNRESOLVED)),
    ("not measured", (NOT_MEASURED,)),
    ("untested", (UNTESTED,)),
    ("no zero", (NO_ZERO,)),
)
"""Words of trust, the worst first, each with the flags that lead to it."""


def trust_word(flags: str) -> str:
    """Return one word for the flags of one row or of several: the worst of TRUST_WORDS, or `good` without a flag.

    A flag that no word names counts as `doubtful`.
    """
    given = {word for word in flags.split(SEPARATOR) if word}
    for word, members in TRUST_WORDS:
        if given & set(members):
            return word
    return DOUBTFUL if given else TRUSTED


def trust_text(flags: str) -> str:
    """Return one phrase for the flags of a row: the word of trust, or in place of `doubtful` the flag of the doubt."""
    word, given = trust_word(flags), flags.split(SEPARATOR)
    if word == DOUBTFUL:
        return next((flag for flag in NAMED_DOUBTS if flag in given), word)
    return {TRUSTED: "tested and good", UNTESTED: NOT_TESTED}.get(word, word)
