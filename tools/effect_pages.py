"""The pages of the effects, docs/effects.md and docs/effects/NAME.md, generated from the effects (`make docs`)."""

from __future__ import annotations

import importlib
import inspect
import textwrap
from pathlib import Path

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.model.effects import EFFECTS, Effect, EffectParameter, Where

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "effects"
INDEX = ROOT / "docs" / "effects.md"
EXAMPLE = ROOT / "configs" / "rts-6.yaml"

GENERATED_MARK = "<!-- Written by `make docs` from the effects themselves; changes made here are lost. -->"
INDEX_HEAD = f"""# Effects

{GENERATED_MARK}

Deviations from the rigid balance. Each has one physical cause and one file in `balance_cli/model/effects`. They are
fitted by `identify --effect`, declared in the `effects` of a geometry, and searched by `diagnose`. They act in the
order of this table, whatever the order in which they are named.

| effect | place | what |
|---|---|---|
"""
LEGEND = """The effect is absent where its parameters have their null values; a nuisance parameter, which only shapes
the action of the others, has none. The size is that of a change that matters."""
INDEX_FOOT = """
How to add an effect: [a new effect](new-effect.md). The effects of a simulated rig are in the
[command reference](commands.md#effects-of-simulate).
"""


ON_REQUEST = "`diagnose` looks for it only where it is asked to: `--suspect NAME[@PLACE]`.\n"


def pages() -> dict[Path, str]:
    """Every page by its path."""
    geometry = load_geometry(EXAMPLE)
    rows = [f"| [{effect.name}](effects/{effect.name}.md) | {effect.place} | {effect.summary} |" for effect in EFFECTS]
    index = INDEX_HEAD + "\n".join(rows) + "\n" + INDEX_FOOT
    return {INDEX: index} | {FOLDER / f"{effect.name}.md": page(effect, geometry) for effect in EFFECTS}


def page(effect: Effect, geometry: Geometry) -> str:
    """The page of one effect, its parameters shown for a rig."""
    where = _place_with_most_parameters(effect, geometry)
    call = f"{effect.name}@{','.join(where)}" if where else effect.name
    places = len(effect.places(geometry))
    return "\n".join(
        [
            f"# {effect.name}\n",
            f"{GENERATED_MARK}\n",
            _paragraph(effect.summary),
            _paragraph(f"Place: {effect.place}. The rig of `configs/{EXAMPLE.name}` has {_count(places)} for it."),
            *((ON_REQUEST,) if effect.search.on_request else ()),
            "## What it adds\n",
            f"{_formulas(effect)}\n",
            "## Parameters\n",
            _paragraph(f"Values for `{call}` in that rig. {LEGEND}"),
            "| parameter | unit | null | size | bounds | what |",
            "|---|---|---|---|---|---|",
            *(_row(parameter) for parameter in effect.parameters(geometry, where)),
            "\n## Validity\n",
            _paragraph(effect.validity),
            "## Signature in the residual\n",
            _paragraph(effect.signature),
            "## How to distinguish it\n",
            _paragraph(effect.separated_by),
            "## Reference\n",
            _paragraph(effect.reference),
            "[All effects](../effects.md)\n",
        ]
    )


def _place_with_most_parameters(effect: Effect, geometry: Geometry) -> Where:
    """The place with the most parameters, the first of several."""
    return max(effect.places(geometry), key=lambda where: len(effect.parameters(geometry, where)))


def _paragraph(text: str) -> str:
    return textwrap.fill(" ".join(text.split()), 120, break_long_words=False, break_on_hyphens=False) + "\n"


def _count(places: int) -> str:
    return "one place" if places == 1 else f"{places} places"


def _formulas(effect: Effect) -> str:
    """The docstring of the effect's file."""
    return inspect.cleandoc(importlib.import_module(effect.apply.__module__).__doc__ or "")


def _row(parameter: EffectParameter) -> str:
    null = "-" if parameter.nuisance else _number(parameter.null)
    size = f"{parameter.scale:.2g} {parameter.fitted_unit}" if parameter.reciprocal else f"{parameter.scale:.2g}"
    cells = (f"`{parameter.name}`", parameter.unit, null, size, _bounds(parameter), parameter.description)
    return f"| {' | '.join(cells)} |"


def _bounds(parameter: EffectParameter) -> str:
    lower, upper = parameter.lower, parameter.upper
    if np.isinf(lower) and np.isinf(upper):
        return "none"
    if np.isinf(upper):
        return f"from {_number(lower)}"
    return f"{_number(lower)} to {_number(upper)}"


def _number(value: float) -> str:
    return "infinite" if np.isinf(value) else f"{value:.3g}"


def main() -> None:
    """Write the pages, and remove those of effects that no longer exist."""
    FOLDER.mkdir(exist_ok=True)
    written = pages()
    for path in FOLDER.glob("*.md"):
        if path not in written:
            path.unlink()
    for path, text in written.items():
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
