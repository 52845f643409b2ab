"""What kind of response hub loads were reduced with, as an enumeration with details.

Loads store it as one line of text (`HubLoads.response`). The text is the serialized form of `ResponseDescription`:
`response_text` writes it and `parse_response_text` reads it, so that nothing else depends on its wording.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum


class ResponseKind(StrEnum):
    """Where the response of the channels to hub loads comes from."""

    STATIC = "static matrix"
    MEASURED = "measured response"
    PHYSICAL_MODEL = "physical model"
    PAPER_FORM = "paper form"


@dataclass(frozen=True)
class ResponseDescription:
    """Kind of a response and its details; details that do not apply are empty.

    `interpolation` of a measured response; `method` of a model (`computed`, `ls`, `ml`, `ls+ml`); `damping` of the
    paper's form (`diagonal`, `full`); `effects`: names of the effects of a physical model, each once.
    """

    kind: ResponseKind
    method: str = ""
    damping: str = ""
    effects: tuple[str, ...] = ()
    interpolation: str = ""


TEXT_PATTERN = re.compile(
    r"(?P<kind>static matrix|measured response|physical model|paper form)"
    r"(?: \((?P<detail>[^,()]+)(?:, (?P<damping>\w+) damping)?\))?"
    r"(?: with (?P<effects>.+))?"
)


def response_text(description: ResponseDescription) -> str:
    """The description as one line of text."""
    detail = description.interpolation or description.method
    damping = f", {description.damping} damping" if description.damping else ""
    effects = f" with {', '.join(description.effects)}" if description.effects else ""
    return f"{description.kind}{f' ({detail}{damping})' if detail else ''}{effects}"


def parse_response_text(text: str) -> ResponseDescription | None:
    """The inverse of `response_text`; None for a text that it did not write."""
    match = TEXT_PATTERN.fullmatch(text)
    if match is None:
        return None
    kind, detail = ResponseKind(match["kind"]), match["detail"] or ""
    measured = kind is ResponseKind.MEASURED
    return ResponseDescription(
        kind,
        method="" if measured else detail,
        damping=match["damping"] or "",
        effects=tuple(match["effects"].split(", ")) if match["effects"] else (),
        interpolation=detail if measured else "",
    )


def text_with_rotor(response: str, rotor: int) -> str:
    """Return the text of a response with the rotor whose harmonics were reduced, unless it is the first."""
    return response if rotor == 1 else f"{response}, rotor {rotor}"
