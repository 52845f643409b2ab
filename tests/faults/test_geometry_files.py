"""Malformed geometries and plans: YAML that is none, bombs, numbers beyond sense, and names that are wrong."""

import copy
import random

import pytest
import yaml

from studies.mutation.readers import GEOMETRY, PLAN
from tests.faults.conftest import assert_refused, call

HEAD = "format: balance-geometry/1\n"
NAN, INF = float("nan"), float("inf")


def alias_bomb(key, levels=9):
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, levels)]
    return HEAD + "\n".join(lines) + f"\n{key}: *a{levels - 1}\n"


def with_value(*place, value):
    content = copy.deepcopy(GEOMETRY)
    item = content
    for key in place[:-1]:
        item = item[key]
    item[place[-1]] = value
    return yaml.safe_dump(content, sort_keys=False)


def without(*place):
    content = copy.deepcopy(GEOMETRY)
    item = content
    for key in place[:-1]:
        item = item[key]
    del item[place[-1]]
    return yaml.safe_dump(content, sort_keys=False)


TEXTS = {
    "empty": "",
    "comment": "# nothing",
    "bracket": (HEAD + "hub: [1, 2", "line"),
    "tabs": (HEAD + "bodies:\n\t- name: x\n", "line"),
    "random bytes": random.Random(3).randbytes(3000),
    "NUL": HEAD.encode() + b"name: a\x00b\n",
    "latin-1": HEAD.encode() + b"name: Pr\xfcfstand\n",
    "utf-16": yaml.safe_dump(GEOMETRY).encode("utf-16"),
    "a list": "- 1\n",
    "two documents": yaml.safe_dump(GEOMETRY) + "---\n" + yaml.safe_dump(GEOMETRY),
    "a key twice": (yaml.safe_dump(GEOMETRY) + "rig: x\n", "twice"),
    "a key that is a list": yaml.safe_dump(GEOMETRY) + "? [1, 2]\n: 3\n",
    "undefined alias": (HEAD + "hub: *none\n", "line"),
    "alias within itself": HEAD + "bodies: &a [*a]\n",
    "alias bomb": alias_bomb("bodies"),
    "alias bomb under an unknown key": alias_bomb("extra"),
    "deep lists": HEAD + "hub: " + "[" * 5000 + "]" * 5000,
    "deep maps": HEAD + "hub: " + "{a: " * 5000 + "1" + "}" * 5000,
    "five million bytes": HEAD + "hub:\n" + "- 1.5\n" * 800_000,
    "python object": (HEAD + "name: !!python/object/apply:os.system ['true']\n", "line"),
    "python name": (HEAD + "name: !!python/name:os.system\n", "line"),
    **{
        f"{tag} {value}": (without("damping_ratio") + f"damping_ratio: !!{tag} {value}\n", "line")
        for tag, value in (("float", '""'), ("int", '""'), ("int", "abc"), ("bool", "maybe"), ("timestamp", "soon"))
    },
    "impossible date": without("name") + "name: 2001-99-99\n",
    "binary": without("name") + "name: !!binary abc\n",
    "set": without("hub") + "hub: !!set {0.1, 0.2, 0.3}\n",
    "map tag on a list": without("bodies") + "bodies: !!map [1, 2]\n",
}
VALUES = {
    "format of a run": (("format",), "balance-run/1", "format"),
    "version 2": (("format",), "balance-geometry/2", "format"),
    "name a number": (("name",), 3, "name"),
    "name empty": (("name",), "", "name"),
    "rig none": (("rig",), None, "rig"),
    "hub of two": (("hub",), [0.0, 0.1], "hub"),
    "hub NaN": (("hub",), [0.0, 0.0, NAN], "hub"),
    "mass negative": (("bodies", 0, "mass"), -1.0, "bodies[0].mass"),
    "mass with a unit": (("bodies", 0, "mass"), "25 kg", "bodies[0].mass"),
    "mass with a comma": (("bodies", 0, "mass"), "25,0", "bodies[0].mass"),
    "mass true": (("bodies", 0, "mass"), True, "bodies[0].mass"),
    "mass of 400 digits": (("bodies", 0, "mass"), 10**400, "bodies[0].mass"),
    "mass huge": (("bodies", 0, "mass"), 1e308, "bodies"),
    "mass denormal": (("bodies", 0, "mass"), 5e-324, "bodies"),
    "position huge": (("bodies", 0, "position"), [1e300, 0, 0], "bodies"),
    "inertia negative": (("bodies", 0, "inertia", "xx"), -1.0, "bodies[0].inertia"),
    "inertia beyond the triangle": (("bodies", 0, "inertia", "xx"), 20.0, "bodies[0].inertia"),
    "bodies empty": (("bodies",), [], "bodies"),
    "cells empty": (("cells",), [], "cells"),
    "stiffness 0": (("cells", 0, "stiffness"), 0.0, "cells"),
    "stiffness NaN": (("cells", 0, "stiffness"), NAN, "cells"),
    "stiffness infinite": (("cells", 0, "stiffness"), INF, "cells"),
    "stiffness denormal": (("cells", 0, "stiffness"), 5e-324, "cells"),
    "series empty": (("cells", 1, "series"), [], "cells[1]"),
    "axis of no length": (("cells", 0, "axis"), [0, 0, 0], "cells[0]"),
    "axis of 1e200": (("cells", 0, "axis"), [1e200, 0, 0], "cells"),
    "cell twice": (("cells", 1, "name"), "z1", "cells[1]"),
    "channel of no cell": (("channels", 1, "cell"), "y9", "channels[1].cell"),
    "channel twice": (("channels", 1, "name"), "z1.strain", "channels[1]"),
    "sensitivity 0": (("channels", 0, "sensitivity"), 0.0, "channels[0]"),
    "sensitivity whose forces overflow": (("channels", 0, "sensitivity"), -1e-300, "channels[0]"),
    "sensitivity with a unit": (("channels", 0, "sensitivity"), "2 mV/N", "channels[0]"),
    "low-pass negative": (("channels", 1, "lowpass"), -1.0, "channels[1].lowpass"),
    "filter of another type": (("acquisition", "filter", "type"), "chebyshev", "acquisition.filter.type"),
    "filter order 21": (("acquisition", "filter", "order"), 21, "acquisition.filter.order"),
    "damping negative": (("damping_ratio",), -0.01, "damping_ratio"),
    "tolerance as text": (("tolerances", "mass"), "5 %", "tolerances.mass"),
    "blades 3.5": (("rotor", "blades"), 3.5, "rotor.blades"),
    "freedom unknown": (("freedom",), ["roll"], "freedom"),
    "freedom twice": (("freedom",), ["z", "z"], "freedom"),
    "effect unknown": (("effects", 0, "name"), "warp", "effect"),
    "effect at an unknown place": (("effects", 0, "where"), ["q"], "q"),
    "negative added mass": (
        ("effects", 0),
        {"name": "added-mass", "where": [], "parameters": {"mass": -500.0, "x": 0.0, "y": 0.0, "z": 0.0}},
        "added-mass",
    ),
    "effect with NaN": (("effects", 0, "parameters", "delay"), NAN, "effects"),
    "effect with an unknown parameter": (("effects", 0, "parameters"), {"dely": 1e-3}, "dely"),
}
PLANS = {
    "empty": "",
    "no runs": "runs: []\n",
    "not YAML": "runs: [\n",
    "alias bomb": alias_bomb("runs"),
    "kind unknown": ("runs:\n- {run: a, kind: flight}\n", "runs"),
    "unknown key": ("runs:\n- {run: a, kind: zero, durations: 2}\n", "durations"),
    "name twice": "runs:\n- {run: a, kind: zero}\n- {run: a, kind: zero}\n",
    "duration of a year": "runs:\n- {run: a, kind: zero, duration: 3.0e+7}\n",
    "duration NaN": ("runs:\n- {run: a, kind: zero, duration: .nan}\n", "duration"),
    "less than a sample": "runs:\n- {run: a, kind: zero, duration: 1.0e-6}\n",
    "rate 1e12": "runs:\n- {run: a, kind: zero, sample_rate: 1.0e+12}\n",
    "excited unknown": ("runs:\n- {run: a, kind: sweep, excited: [Fq], level: [1.0]}\n", "excited"),
    "levels too few": ("runs:\n- {run: a, kind: sweep, excited: [Fz, Fx], level: [1.0]}\n", "level"),
    "band above half the rate": "runs:\n- {run: a, kind: sweep, excited: [Fz], level: [1.0], band: [20.0, 3000.0]}\n",
    "1e9 periods": "runs:\n- {run: a, kind: sweep, excited: [Fz], level: [1.0], periods: 1000000000}\n",
    "1e9 steps": "runs:\n- {run: a, kind: static, largest: {Fz: 100.0}, steps: 1000000000}\n",
    "rotor faster than the samples": "runs:\n- {run: a, kind: wind, rotor_speed: 1.0e+9, duration: 1.0}\n",
    **{
        f"name {name!r}": f"runs:\n- {{run: {name}, kind: zero, duration: 2.0}}\n"
        for name in ("../../escaped", "sub/a", "/tmp/absolute", "''", "'  '", '"a\\0b"', "n" * 300)
    },
}


def with_words(cases):
    return [
        pytest.param(*(case if isinstance(case, tuple) else (case, "")), id=name.replace("\x00", "NUL"))
        for name, case in cases.items()
    ]


def write(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize(("text", "word"), with_words(TEXTS))
def test_text_that_is_no_geometry_is_refused(examples, tmp_path, out, text, word):
    path = write(tmp_path / "bad.yaml", text)
    assert_refused(call("modes", "-g", path), out, "bad.yaml", word)


@pytest.mark.parametrize(("place", "value", "word"), VALUES.values(), ids=VALUES)
@pytest.mark.parametrize("command", ["modes", "check", "simulate"])
def test_a_value_beyond_sense_is_refused(examples, tmp_path, out, command, place, value, word):
    path = write(tmp_path / "bad.yaml", with_value(*place, value=value))
    assert_refused(call(*examples.words(command, path, out)), out, "bad.yaml", word)


@pytest.mark.parametrize("key", ["name", "rig", "hub", "channels"])
def test_a_missing_key_is_named(examples, tmp_path, out, key):
    assert_refused(call("modes", "-g", write(tmp_path / "bad.yaml", without(key))), out, "bad.yaml", key)


def test_a_misspelled_key_is_named_with_the_nearest_one(examples, tmp_path, out):
    text = yaml.safe_dump({**{k: v for k, v in GEOMETRY.items() if k != "channels"}, "chanels": GEOMETRY["channels"]})
    assert_refused(call("modes", "-g", write(tmp_path / "bad.yaml", text)), out, "chanels", "channels")


@pytest.mark.parametrize("change", [lambda t: b"\xef\xbb\xbf" + t, lambda t: t.replace(b"\n", b"\r\n")])
def test_marks_of_other_editors_do_no_harm(examples, tmp_path, change):
    path = write(tmp_path / "good.yaml", change(yaml.safe_dump(GEOMETRY, sort_keys=False).encode()))
    assert call("modes", "-g", path).exit_code == 0


@pytest.mark.parametrize(("text", "word"), with_words(PLANS))
def test_a_plan_out_of_range_is_refused(examples, tmp_path, out, text, word):
    path = write(tmp_path / "plan.yaml", text)
    assert_refused(call(*examples.words("plan", path, out)), out, "plan.yaml", word)
    assert not list(tmp_path.parent.glob("*escaped*"))


def test_the_plan_of_the_examples_is_accepted(examples, tmp_path, out):
    path = write(tmp_path / "plan.yaml", yaml.safe_dump({"runs": PLAN["runs"][:1]}))
    assert call(*examples.words("plan", path, out)).exit_code == 0
