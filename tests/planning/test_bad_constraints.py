"""Malformed and impossible constraints of a plan: exit 2, one message, nothing written."""

import pytest
import yaml
from click.testing import CliRunner

from balance_cli.cli import balance
from tests.support.rigs import CONFIGS

HALLS = {
    "unknown key": ({"shakers": 2}, "shakers"),
    "misspelt key": ({"exciter": {"Fx": {"rms": 1}}}, "exciters"),
    "other format": ({"format": "balance-hall/9"}, "format"),
    "no exciter": ({"exciters": {}}, "exciters"),
    "exciter without a limit": ({"exciters": {"Fx": {}}}, "rms"),
    "negative force": ({"exciters": {"Fx": {"rms": -3}}}, "exciters.Fx.rms"),
    "infinite force": ({"exciters": {"Fx": {"peak": ".inf"}}}, "exciters.Fx.peak"),
    "no component": ({"exciters": {"Fq": {"rms": 1}}}, "Fq"),
    "force in words": ({"exciters": {"Fx": {"rms": "strong"}}}, "exciters.Fx.rms"),
    "more at once than exciters": ({"exciters": {"Fx": {"rms": 1}}, "simultaneous": 2}, "simultaneous"),
    "seven at once": ({"simultaneous": 7}, "simultaneous"),
    "none at once": ({"simultaneous": 0}, "simultaneous"),
    "negative change": ({"change_minutes": -1}, "change_minutes"),
    "endless overhead": ({"overhead_minutes": float("inf")}, "overhead_minutes"),
    "falling band": ({"band": [100.0, 10.0]}, "should rise"),
    "band of one number": ({"band": [10.0]}, "band"),
    "falling further band": ({"bands": [[5.0, 5.0]]}, "should rise"),
    "no sample rate": ({"sample_rate": 0}, "sample_rate"),
    "no period": ({"period": 0}, "period"),
    "one period": ({"periods": [1]}, "periods"),
    "no numbers of periods": ({"periods": []}, "periods"),
    "a number of periods twice": ({"periods": [7, 7]}, "twice"),
    "half a period": ({"periods": [7.5]}, "periods"),
    "level above the largest": ({"levels": [1.5]}, "levels"),
    "no level": ({"levels": [0.0]}, "levels"),
    "speed below zero": ({"rotor_speeds": [-5.0]}, "rotor_speeds"),
    "unknown excitation": ({"excitations": ["chirp"]}, "excitations"),
    "hits as a choice of excitation": ({"excitations": ["impact"]}, "hammer"),
    "hammer without force": ({"hammer": {"peak": 0}}, "hammer.peak"),
    "hammer without points": ({"hammer": {"peak": 10}}, "hammer.points"),
    "hits that follow at once": ({"hammer": {"peak": 10, "period": 0.01}}, "hammer.period"),
    "hit without direction": (
        {"hammer": {"peak": 10, "points": {"a": {"position": [0, 0, 0], "direction": [0, 0, 0]}}}},
        "no length",
    ),
    "contact longer than the time between hits": (
        {"hammer": {"peak": 10, "contact": 1.0, "points": {"a": {"position": [0, 0, 0], "direction": [0, 0, 1]}}}},
        "contact",
    ),
    "mean load of no component": ({"trims": [{"Fq": 1.0}]}, "trims"),
    "mean load beyond the cells": ({"trims": [{"Fz": 1e9}]}, "mean loads"),
    "a mean load twice": ({"trims": [{"Fz": 1.0}, {"Fz": 1.0}]}, "twice"),
    "unknown spectrum": ({"spectrum": "pink"}, "spectrum"),
    "static runs in no time": ({"minutes_per_point": 0}, "minutes_per_point"),
    "static runs without loads": ({"minutes_per_point": 1.0}, "static_loads"),
    "unknown phases": ({"phases": "golden"}, "phases"),
    "share above one": ({"cell_share": 1.2}, "cell_share"),
    "no margin": ({"margin": 0}, "margin"),
    "load of zero": ({"loads": {"Fz": 0}}, "loads.Fz"),
    "noise below zero": ({"noise": {"strain": -1e-3}}, "noise.strain"),
    "noise of a kind that is none": ({"noise": {"gauge": 1e-3}}, "gauge"),
    "noise of an unknown channel": ({"noise": {"channels": {"nowhere": 1e-3}}}, "nowhere"),
    "static load of nothing": ({"static_loads": {}}, "static_loads"),
    "unknown effect": ({"effects": ["gremlin"]}, "gremlin"),
    "band beyond the sample rate": ({"band": [5.0, 900.0], "sample_rate": 500.0}, "sample rate"),
    "period without lines": ({"period": 1e-3}, "has no two lines"),
    "record without end": ({"period": 100.0, "periods": [1000]}, "more than"),
    "speed beyond the sample rate": ({"rotor_speeds": [1e4]}, "rotor speed"),
}
CALLS = {
    "no minutes": (["-o", "plan.yaml"], "--minutes"),
    "no output": (["--minutes", "5"], "-o"),
    "minutes below zero": (["--minutes", "-5", "-o", "plan.yaml"], "--minutes"),
    "minutes without end": (["--minutes", "inf", "-o", "plan.yaml"], "--minutes"),
    "certain alarm": (["--minutes", "5", "--level", "1", "-o", "plan.yaml"], "--level"),
    "comparison with nothing": (["--compare", "geometry.yaml"], "balance-plan/1"),
    "minutes of a static schedule": (["--points", "50", "--minutes", "5", "-o", "plan.yaml"], "--minutes"),
    "no loads of a static schedule": (["--points", "50", "-o", "plan.yaml"], "static_loads"),
}


def call(folder, words):
    """Run `balance plan` in a folder with the geometry of the sample rig; the result, and the files it left."""
    geometry = folder / "geometry.yaml"
    geometry.write_text((CONFIGS / "rts-6.yaml").read_text())
    before = set(folder.iterdir())
    named = [str(folder / word) if word.endswith(".yaml") else word for word in words]
    result = CliRunner().invoke(balance, ["plan", "-g", str(geometry), *named])
    return result, set(folder.iterdir()) - before


@pytest.mark.parametrize("name", HALLS)
def test_impossible_halls_are_refused(name, tmp_path):
    changes, fault = HALLS[name]
    (tmp_path / "hall.yaml").write_text(yaml.safe_dump({"format": "balance-hall/1", **changes}))
    result, left = call(tmp_path, ["--minutes", "5", "--hall", "hall.yaml", "-o", "plan.yaml"])
    assert result.exit_code == 2, result.output
    assert fault in result.output and "Traceback" not in result.output and not left
    assert sum(line.startswith("balance: error:") for line in result.output.splitlines()) == 1


@pytest.mark.parametrize("name", CALLS)
def test_impossible_calls_are_refused(name, tmp_path):
    words, fault = CALLS[name]
    result, left = call(tmp_path, words)
    assert result.exit_code == 2 and fault in result.output and not left, result.output


@pytest.mark.parametrize("text", ["", "- a\n- b\n", "format: balance-hall/1\nperiods: [7\n", "\x00\x01"])
def test_files_that_are_no_hall_are_refused(text, tmp_path):
    (tmp_path / "hall.yaml").write_text(text)
    result, left = call(tmp_path, ["--minutes", "5", "--hall", "hall.yaml", "-o", "plan.yaml"])
    assert result.exit_code == 2 and "hall.yaml" in result.output and not left
