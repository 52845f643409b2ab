"""Words that must not come back, what replaces them, and where they may stand; used by `tests/test_vocabulary.py`."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]
CODE_FOLDERS = ("balance_cli", "tests", "studies", "benchmarks", "tools")
DEFINITIONS = frozenset({Path("tests/support/vocabulary.py"), Path("tests/test_vocabulary.py")})
"""The files that must write the words down."""

IDENTIFIER_PARTS = {
    "gage": "calibration model, math model",
    "jet": "dual number",
    "jets": "dual numbers",
    "surplus": "redundancy, residual test",
    "spill": "cross-axis matrix of the exciter",
    "pickup": "mains interference",
    "suspects": "outliers",
    "believed": "drop_unsupported_effects",
    "contested": "compare_alternatives",
    "improbability": "p_value",
    "sown": "initial candidates",
    "wronged": "nuisance parameter",
    "coast": "Predictor, predict_through_gap",
    "gust": "first-order Markov process",
    "soundness": "DataQuality",
    "stretch": "Segment",
    "stretches": "segments",
    "blur": "confounding limit",
    "nowhere": "whole_rig",
    "crowd": "competing effects",
    "wandering": "low-pass drift",
    "colour": "color",
    "colours": "colors",
    "modelled": "modeled",
    "labelled": "labeled",
}
"""Parts of identifiers (`gage` in `GageModel` and `gage_model`) and what to use instead."""

IDENTIFIERS = {
    "begun_anew": "restart",
    "told": "information, stated",
    "settled": "fit_until_stable",
    "started_again": "restart",
    "led_on": "predict_through_gap",
    "linear_part": "nonlinear contribution removed",
    "log_volume": "log-determinant inflation",
    "shares_that_explain": "estimate_model_error",
    "unseen": "unidentifiable",
    "undetermined": "unidentifiable",
    "rests_on": "informed_by",
    "exchanged": "swapped_channels",
    "examined": "screen_outliers",
    "BadSequence": "SuspectLoadSeries",
    "stated_calibration": "calibration_from_matrix",
    "matrix_lines": "matrix rows",
    "loads_as": "load_model",
    "with_only": "keep_effects",
    "scanned": "start_from_score",
    "sized": "extra_starts",
    "searched": "search_places",
    "Standing": "EffectSupport",
    "recognise": "sniff_format",
}
"""Whole identifiers and what to use instead."""

PHRASES = {
    r"\bgages?\b": "calibration model",
    r"\bjets?\b": "dual number",
    r"\bsurplus\b": "redundancy, redundant channels, residual test",
    r"\bspills?\b|\bspilt\b|\bspilled\b": "cross-axis load of the exciter",
    r"\bpick-ups?\b": "mains interference",
    r"\bsuspects\b": "outliers",
    r"\bbelieved\b": "accepted, supported",
    r"\bcontested\b": "compared with alternatives",
    r"\bimprobability\b": "p-value",
    r"\bsown\b": "initial candidates",
    r"\bwronged\b": "nuisance parameter",
    r"\bbegun anew\b|\bstarted again\b": "restarted",
    r"\bnowhere in particular\b": "whole rig",
    r"\bsoundness\b": "data quality",
    r"\bmend(s|ed|ing)?\b": "repair",
    r"\ba fault of ours\b|\binternal fault\b": "internal error",
    r"\bno rig is like this\b|\bwithout inertia is none\b": "these parameters are not physical",
    r"\ba lag of \S+ s is none\b": "lag must be finite and non-negative",
    r"\bloading sequences?\b": "load series",
    r"\bsays? less than it seems\b": "uncertainties are underestimated",
    r"\bsays? nothing of\b": "not testable with these runs",
    r"\bclos(e|es|ed|ing) the loop\b|\bloop (is )?closed\b": "model updating",
    r"\bclosed models?\b": "updated model",
    r"\bnoise alone (would leave|leaves)\b": "noise floor",
    r"\bfree motions?\b": "transient",
    r"\blower body\b": "non-metric side, ground side",
    r"\bmoving part\b": "metric side",
    r"\bmodell(ed|ing)\b|\bcolours?\b|\bgrey\b": "American spelling",
    r"\bbehaviours?\b|\bpenalis(e|ed|es)\b|\brasteris(e|ed)\b|\brecognis(e|es|ed)\b|\blabelled\b": "American spelling",
    r"\banything that chance would not\b": "no candidate is significant",
    r"\bled on\b": "predicted through a gap",
}
"""Patterns in prose (docstrings, comments, messages, manual, page) and what to write instead."""

FIXED_NAMES = {
    "mains-pickup": "name of an effect, fixed by the contract",
    "MainsPickup": "class of that effect",
    "mains_pickup": "module of that effect: modules of effects are named after them",
    '"gage"': "name in files and former key of the JSON, kept for one release",
    "`gage`": "former key of the JSON, kept for one release",
    "strain gage": "the sensor itself is called so",
    "Strain-Gage": "title of a standard",
    "strain-gage": "the sensor itself is called so",
    "unmodelled line": "flag of a row of loads, fixed by the contract",
    "not_testable": "key of the JSON, fixed by the contract",
    "--loads-as": "former name of an option, kept for one release",
    "rests_on": "key of the JSON, fixed by the contract",
}
"""Names that keep an old word, and the reason."""


def _pattern(phrases: Iterable[str]) -> re.Pattern[str]:
    """Any of these phrases, with line breaks, also of comments, between their words."""
    return re.compile("|".join(phrases).replace(" ", r"\s+(?:#\s+)?"), re.IGNORECASE)


_ANY_PHRASE = _pattern(PHRASES)
_PATTERNS = [(_pattern([phrase]), better) for phrase, better in PHRASES.items()]


def code_files() -> Iterator[Path]:
    """All Python files, relative to the root."""
    for folder in CODE_FOLDERS:
        yield from (path.relative_to(ROOT) for path in sorted((ROOT / folder).rglob("*.py")))


def prose_files() -> Iterator[Path]:
    """The manual, the front pages, and the template of the report, relative to the root."""
    for pattern in ("*.md", "docs/**/*.md", "balance_cli/report/*.html", "balance_cli/report/*.css", "configs/*.yaml"):
        yield from (path.relative_to(ROOT) for path in sorted(ROOT.glob(pattern)))


def identifier_parts(name: str) -> list[str]:
    """`GageModel_old2` -> gage, model, old: the words of an identifier."""
    words = re.sub(r"([a-z0-9])([A-Z])|([A-Z])([A-Z][a-z])", r"\1\3_\2\4", name).lower()
    return [re.sub(r"\d+$", "", word) for word in words.split("_") if word]


def identifier_offence(name: str, path: Path = Path()) -> str | None:
    """What to use instead of an identifier in this file; None where it may stand."""
    if name in FIXED_NAMES:
        return None
    if name == "seeds" and path.parts[:1] == ("balance_cli",):
        # Elsewhere these are the seeds of random numbers.
        return "initial_candidates"
    if name.startswith("test_"):
        # The name of a test is a sentence.
        return next((better for _, _, better in phrase_offences(name.replace("_", " "))), None)
    if name in IDENTIFIERS:
        return IDENTIFIERS[name]
    return next((IDENTIFIER_PARTS[part] for part in identifier_parts(name) if part in IDENTIFIER_PARTS), None)


def phrase_offences(text: str) -> Iterator[tuple[int, str, str]]:
    """(line from 0, words, what to write instead) of all forbidden phrases in a text."""
    for name in FIXED_NAMES:
        text = text.replace(name, "#" * len(name))
    if not _ANY_PHRASE.search(text):
        return
    for pattern, better in _PATTERNS:
        for match in pattern.finditer(text):
            yield text.count("\n", 0, match.start()), " ".join(match.group().split()), better


def offences_of_code(path: Path) -> Iterator[str]:
    """All offences of a Python file: identifiers, then prose in comments and strings."""
    source = (ROOT / path).read_text(encoding="utf-8")
    tokens = list(tokenize.generate_tokens(io.StringIO(source).readline))
    names = [token for token in tokens if token.type == tokenize.NAME]
    offences = {name: identifier_offence(name, path) for name in {token.string for token in names}}
    for token in names:
        if better := offences[token.string]:
            yield f"{path}:{token.start[0]}: `{token.string}`: {better}"
    for start, text in _prose_of_code(source, [token for token in tokens if token.type == tokenize.COMMENT]):
        for line, words, better in phrase_offences(text):
            yield f"{path}:{start + line}: `{words}`: {better}"


def _prose_of_code(source: str, comments: Sequence[tokenize.TokenInfo]) -> Iterator[tuple[int, str]]:
    """(first line, text) of strings that hold more than one word, and of blocks of comments."""
    for node in ast.walk(ast.parse(source)):
        # A string of a single word is a key, a stored name or an option, not prose.
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and len(node.value.split()) > 1:
            yield node.lineno, node.value
    block: list[str] = []
    start = 0
    for token in comments:
        if block and token.start[0] != start + len(block):
            yield start, "\n".join(block)
            block = []
        start = start if block else token.start[0]
        block.append(token.string)
    if block:
        yield start, "\n".join(block)


def offences_of_prose(path: Path) -> Iterator[str]:
    """All offences of a page of prose, code in backquotes aside: it names options, keys and files."""
    text = (ROOT / path).read_text(encoding="utf-8")
    text = re.sub(r"`[^`\n]+`", lambda match: " " * len(match.group()), text)
    for line, words, better in phrase_offences(text):
        yield f"{path}:{line + 1}: `{words}`: {better}"
