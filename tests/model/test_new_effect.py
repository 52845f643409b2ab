"""The manual's page on a new effect is true: its effect, put into the list, passes the checks of the library."""

import importlib.util
import re
import sys
from pathlib import Path

import pytest

from balance_cli.model import effects
from balance_cli.model.placed_effects import add_effects, declared_effects
from tests.support.effect_checks import (
    RIG,
    TrueEffect,
    check_change,
    check_derivatives,
    check_likelihood_derivatives,
    check_null,
    check_recovery,
    recover_effect,
)

PAGE = Path(__file__).parents[2] / "docs" / "new-effect.md"
TRUE_DAMPING = 25.0


def module_of(block, name, folder, monkeypatch):
    """The module that a block of the page makes."""
    path = folder / f"{name}.py"
    path.write_text(block, encoding="utf-8")
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def blocks():
    found = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert len(found) == 2
    return found


@pytest.fixture
def effect(blocks, tmp_path, monkeypatch):
    """The effect of the page, in the list after the others."""
    new = module_of(blocks[0], "cell_dashpot", tmp_path, monkeypatch).EFFECT
    monkeypatch.setattr(effects, "EFFECTS", (*effects.EFFECTS, new))
    return new


def test_it_is_known_at_its_places(effect):
    (placed,) = declared_effects(add_effects(RIG, [f"{effect.name}@z1"]))
    assert placed.effect is effect
    assert len(effect.places(RIG)) == len(RIG.cells)


@pytest.mark.parametrize("where", [("x",), ("z4",)], ids=",".join)
def test_it_passes_the_checks_of_the_equations(effect, where):
    check_null(effect, where)
    check_derivatives(effect, where)
    check_likelihood_derivatives(effect, where)
    check_change(effect, where)


def test_it_is_found_in_a_simulated_campaign(effect, blocks, tmp_path, monkeypatch):
    extension = module_of(blocks[1], "cell_dashpot_truth", tmp_path, monkeypatch).CellDashpot
    true = extension(("z1",), damping=TRUE_DAMPING)
    check_recovery(
        recover_effect(
            effect.name, TrueEffect(("z1",), {"damping": TRUE_DAMPING}, lambda rig: rig.with_extensions(true)), 1
        )
    )


def test_it_gets_a_page(effect):
    from tests.support.tools import tool

    pages = tool("effect_pages")
    text = pages.page(effect, RIG)
    assert "D -> D + d E_i' E_i" in text and "| `damping` | N s/m | 0 |" in text
