"""Which terms a calibration model may have: searched for, a whole family, or those that the user lists."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.terms import Term, all_terms, linear_terms
from balance_cli.io.errors import UserError

SEARCH, LINEAR, QUADRATIC, LISTED = "search", "linear", "quadratic", "list"
TERM_SIGNIFICANCE_LEVEL = 0.01
"""Probability of a spurious term anywhere in the balance, by default."""


@dataclass(frozen=True)
class TermChoice:
    """The terms that a model may have beside the loads themselves, which it always has.

    `kind`: `search`, a search among the ten families of AIAA R-091 with at most the probability `significance` of a
    spurious term; `linear`, none; `quadratic`, all squares and products; `list`, the `listed` ones in every channel and
    those of `by_channel` in a channel beside them.
    """

    kind: str = SEARCH
    significance: float = TERM_SIGNIFICANCE_LEVEL
    listed: tuple[str, ...] = ()
    by_channel: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def is_search(self) -> bool:
        """Whether the terms of each channel are searched for."""
        return self.kind == SEARCH

    @property
    def is_linear(self) -> bool:
        """Whether the model has the loads alone."""
        return self.kind == LINEAR

    @property
    def all_listed_terms(self) -> tuple[str, ...]:
        """The terms listed for any channel."""
        return tuple(dict.fromkeys((*self.listed, *(name for names in self.by_channel.values() for name in names))))

    def candidates(self, components: Sequence[str]) -> tuple[Term, ...]:
        """All terms that some channel may have, in the order of AIAA R-091, the loads first."""
        every = all_terms(len(components))
        if self.is_search:
            return every
        wanted = set(linear_terms(len(components)))
        wanted |= {term for term in every if term.is_quadratic and self.kind == QUADRATIC}
        wanted |= self._listed_terms(
            components, (*self.listed, *(each for own in self.by_channel.values() for each in own))
        )
        return tuple(term for term in every if term in wanted)

    def of_channel(self, channel: str, components: Sequence[str]) -> set[Term]:
        """The terms that a channel is to have, where they are not searched for."""
        if self.kind != LISTED:
            return set(self.candidates(components))
        own = self._listed_terms(components, (*self.listed, *self.by_channel.get(channel, ())))
        return own | set(linear_terms(len(components)))

    def for_all_channels(self) -> TermChoice:
        """The same terms in every output, for loads as functions of the readings."""
        return replace(self, listed=self.all_listed_terms, by_channel={})

    @staticmethod
    def _listed_terms(components: Sequence[str], names: Iterable[str]) -> set[Term]:
        return {parse_term(name, components) for name in names}


SEARCHED, LINEAR_TERMS = TermChoice(), TermChoice(LINEAR)
"""The default choice, and that of the loads alone."""


def parse_term(text: str, components: Sequence[str]) -> Term:
    """The term that a text names: `Fx^2`, `Fx Fy`, `Fy*Fx`, `Fx |My|`, `|Fx^3|`.

    Raises UserError, without file and place, for an unknown one.
    """
    spellings = _spellings(components)
    term = spellings.get(_plain(text))
    if term is None:
        names = [each.name(components) for each in all_terms(len(components))]
        near = difflib.get_close_matches(text.strip(), names, n=1, cutoff=0.5)
        example = f"{components[0]}^2, {components[0]} {components[-1]}, {components[0]} |{components[-1]}|"
        remedy = f"Is it `{near[0]}`?" if near else f"Terms are written as {example}, of {', '.join(components)}"
        raise UserError(f"unknown term `{text.strip()[:60]}`", remedy=remedy)
    return term


def _spellings(components: Sequence[str]) -> dict[str, Term]:
    """Each term by the ways in which it is written, factors in either order."""
    known: dict[str, Term] = {}
    for term in all_terms(len(components)):
        known.setdefault(_plain(term.name(components)), term)
        if not term.single_load:
            turned = Term(term.j, term.other_function, term.i, term.function)
            known.setdefault(_plain(turned.name(components)), term)
    for i, name in enumerate(components):
        known.setdefault(_plain(name * 2), next(term for term in all_terms(len(components)) if _is_square(term, i)))
    return known


def _is_square(term: Term, i: int) -> bool:
    return term.single_load and term.is_quadratic and term.i == i


def _plain(text: str) -> str:
    """A spelling without spaces and signs of multiplication, with powers written as `^2`."""
    text = text.replace("²", "^2").replace("³", "^3")
    return "".join(letter for letter in text if not letter.isspace() and letter not in "*·")


def choice_of_words(terms: str | Sequence[str], significance: float) -> TermChoice:
    """The choice `search`, `linear` or `quadratic`, or that of listed terms, as a sequence or separated by commas."""
    if isinstance(terms, str) and terms in (SEARCH, LINEAR, QUADRATIC):
        return TermChoice(terms, significance)
    names = terms.split(",") if isinstance(terms, str) else list(terms)
    listed = tuple(name.strip() for name in names if name.strip())
    if not listed:
        raise UserError("lists no term", place="--terms", remedy="Give search, linear, quadratic or a list of terms")
    return TermChoice(LISTED, significance, listed)


def choice_of_lines(lines: Iterable[str], place: str, components: Sequence[str]) -> TermChoice:
    """The choice that lines of text state: a term of all channels, or `channel: term, term` of one.

    Also as YAML: items may follow a line `channel:` with `- `, and stand in brackets and quotes. What follows `#` is a
    comment. Raises UserError, with the line, for an unknown term, and where no term is left.
    """
    listed: list[str] = []
    by_channel: dict[str, tuple[str, ...]] = {}
    block = ""
    for number, line in enumerate(lines, 1):
        text = line.partition("#")[0].strip()
        is_item = text.startswith("- ")
        channel, colon, rest = ("", "", text[2:]) if is_item else text.partition(":")
        names = tuple(
            name
            for part in (rest if colon or is_item else text).strip(" []").split(",")
            if (name := part.strip(" \"'"))
        )
        for name in names:
            try:
                parse_term(name, components)
            except UserError as error:
                raise error.with_location(file=place, place=f"line {number}") from None
        block = channel.strip(" \"'") if colon else block if is_item else ""
        if block:
            by_channel[block] = (*by_channel.get(block, ()), *names)
        else:
            listed += names
    if not listed and not any(by_channel.values()):
        remedy = "Write a term in each line, `Fx^2` or `channel: Fx^2, Fx Fy`; for the loads alone give --terms linear"
        raise UserError("lists no term", place, "--terms", remedy)
    return TermChoice(LISTED, listed=tuple(listed), by_channel=by_channel)


def choice_of_model(model: CalibrationModel) -> TermChoice:
    """The terms that each channel of a model has beside the loads."""
    linear = len(model.components)
    by_channel = {
        name: tuple(itertools.compress(model.terms[linear:], model.coefficients[linear:, channel] != 0.0))
        for channel, name in enumerate(model.channel_names)
    }
    return TermChoice(LISTED, by_channel=by_channel)


def require_known_names(choice: TermChoice, channels: Sequence[str], components: Sequence[str], place: str) -> None:
    """Raise UserError for a term or a channel that the balance does not have."""
    for channel in choice.by_channel:
        if channel not in channels:
            near = difflib.get_close_matches(channel, channels, n=1, cutoff=0.4)
            remedy = f"Is it `{near[0]}`?" if near else f"The channels are {', '.join(channels)}"
            raise UserError(f"the balance has no channel `{channel}`", place, "--terms", remedy)
    for name in choice.all_listed_terms:
        try:
            parse_term(name, components)
        except UserError as error:
            raise error.with_location(file=place, place="--terms") from None
