"""Messages on many runs in few lines: those that differ only in run and numbers are one line with the first runs.

wind-1: channel z2.strain left out: dead: constant at 0.25 V
wind-2: channel z2.strain left out: dead: constant at 0.31 V         and 300 more become
302 runs (wind-1, wind-2, wind-3, ...): channel z2.strain left out: dead: constant at 0.25 to 0.31 V
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

MOST_LINES = 3
"""Messages of one kind that have a line each: of so few, the numbers of each run tell more than their range."""
MOST_NAMES = 3
"""Runs that a common line names: whoever looks into one of them sees what is the matter."""
RUN = "\0"
"""Stands for the run in a message of many."""
NUMBER = re.compile(r"(?<![\w.+-])[+-]?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?(?![\w.]*\w)")
"""A number that is no part of a name (`z2.strain`, `wind-001`) or of a unit (`4P`)."""

WORD = re.compile(r"[\w.+-]+")
"""What may be the name of a run."""


@dataclass(frozen=True)
class RunMessage:
    """What is said of a run, or of its file, whose name the text contains; `run` is empty where it is said of none."""

    run: str
    text: str


def message_lines(messages: Iterable[RunMessage]) -> Iterator[str]:
    """Yield the texts of messages, those of one kind together; one text for a kind that many runs have."""
    kinds: dict[str, list[RunMessage]] = {}
    for message in messages:
        kinds.setdefault(NUMBER.sub("#", _without_run(message)), []).append(message)
    for group in kinds.values():
        if len(group) <= MOST_LINES or not group[0].run:
            yield from (message.text for message in group)
        else:
            yield _common_text(group)


def messages_of_runs(texts: Iterable[str], names: Collection[str]) -> Iterator[RunMessage]:
    """Yield texts as messages on the first of the named runs that each contains."""
    for text in texts:
        words = (word.rstrip(".") for word in WORD.findall(text))
        yield RunMessage(next((word for word in words if word in names), ""), text)


def name_runs(names: Iterable[str]) -> str:
    """Return `N runs (A, B, C, ...)`."""
    listed = list(dict.fromkeys(names))
    rest = ", ..." if len(listed) > MOST_NAMES else ""
    return f"{len(listed)} runs ({', '.join(listed[:MOST_NAMES])}{rest})"


def _without_run(message: RunMessage) -> str:
    """The text with RUN in place of the name, where it is a word: `a` is no part of `gap` or `a.h5`."""
    if not message.run:
        return message.text
    return re.sub(rf"(?<![\w./+-]){re.escape(message.run)}(?![\w/+-]|\.\w)", RUN, message.text)


def _common_text(group: list[RunMessage]) -> str:
    """The text of the first message with all runs in place of its own, and the ranges of numbers that differ."""
    texts = [_without_run(message) for message in group]
    ranges = (_number_range(values) for values in zip(*(NUMBER.findall(text) for text in texts), strict=True))
    text = NUMBER.sub(lambda _: next(ranges), texts[0])
    return text.replace(RUN, name_runs(message.run for message in group))


def _number_range(values: tuple[str, ...]) -> str:
    low, high = min(values, key=float), max(values, key=float)
    return low if float(low) == float(high) else f"{low} to {high}"
