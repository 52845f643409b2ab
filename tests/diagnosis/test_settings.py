"""Settings of a diagnosis: stored with it, absent in older artefacts, documented, and in use."""

import ast
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import pytest

import balance_cli.diagnosis
from balance_cli.diagnosis.result import Diagnosis
from balance_cli.diagnosis.search.score_statistics import Score
from balance_cli.diagnosis.selection.confirm import select_significant
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS, SearchSettings
from balance_cli.io.hdf5_tree import from_tree, to_tree
from tests.support.diagnosis_content import diagnosis

PACKAGE = Path(balance_cli.diagnosis.__file__).parent
CONSISTENCY = PACKAGE / "consistency"


def test_settings_come_back_from_a_tree():
    changed = replace(DEFAULT_SETTINGS, score=replace(DEFAULT_SETTINGS.score, step_fractions=(1.0, 0.5)))
    assert from_tree(to_tree(changed), SearchSettings) == changed


def test_a_diagnosis_stores_its_settings_and_older_ones_have_none():
    tree = to_tree(diagnosis(settings=DEFAULT_SETTINGS))
    assert from_tree(tree, Diagnosis).settings == DEFAULT_SETTINGS
    del tree["settings"]
    assert from_tree(tree, Diagnosis).settings is None


def test_fields_keep_their_names_in_files():
    tree = to_tree(diagnosis())
    assert {"tests", "not_testable", "candidates"} <= set(tree)
    assert {"why", "folds"} <= set(tree["trials"]["0"])
    assert set(tree["not_testable"]["0"]) == {"name", "why"}
    assert "folds" in tree["effects"]["0"]["evidence"]


def test_every_setting_has_a_reason():
    for path in (
        PACKAGE / "settings.py",
        PACKAGE / "data_test_settings.py",
    ):
        for group in ast.parse(path.read_text(encoding="utf-8")).body:
            if not isinstance(group, ast.ClassDef):
                continue
            for item, following in zip(group.body, [*group.body[1:], None], strict=True):
                if isinstance(item, ast.AnnAssign) and not ast.unparse(item.annotation).endswith("Settings"):
                    assert isinstance(following, ast.Expr), f"{path.name}: {ast.unparse(item.target)} has no reason"


def test_no_number_tunes_an_algorithm_outside_the_settings():
    """Significance levels and the frequencies of mains are no tuning; checks of consistency are no part of a search."""
    for path in set(PACKAGE.rglob("*.py")) - set(CONSISTENCY.rglob("*.py")):
        if path.name in ("settings.py", "data_test_settings.py", "significance.py", "choices.py"):
            continue
        for item in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(item, ast.Assign) and isinstance(item.value, ast.Constant):
                name = ast.unparse(item.targets[0])
                assert isinstance(item.value.value, str) or name == "CHI2_95", f"{path.name}: {name}"


def test_every_constant_of_the_consistency_checks_has_its_reason():
    for path in CONSISTENCY.rglob("*.py"):
        body = ast.parse(path.read_text(encoding="utf-8")).body
        for item, following in zip(body, [*body[1:], None], strict=True):
            if isinstance(item, ast.Assign) and isinstance(item.value, ast.Constant):
                is_text = isinstance(item.value.value, str)
                assert is_text or isinstance(following, ast.Expr), f"{path.name}: {ast.unparse(item)} has no reason"


def test_all_groups_are_frozen_and_have_defaults():
    def groups(value):
        yield value
        for item in fields(value):
            if is_dataclass(getattr(value, item.name)):
                yield from groups(getattr(value, item.name))

    for group in groups(SearchSettings()):
        assert type(group)() == group
        with pytest.raises(AttributeError):
            setattr(group, fields(group)[0].name, None)


def test_a_stricter_level_selects_nothing():
    score = Score(None, 0, 30.0, 1, 0.0, float("inf"), None, None, None)
    strict = replace(DEFAULT_SETTINGS.selection, significance_level=1e-9)
    assert select_significant([score], 100, DEFAULT_SETTINGS) == [score]
    assert select_significant([score], 100, replace(DEFAULT_SETTINGS, selection=strict)) == []
