"""Random sound geometries for property tests."""

from typing import Any

import numpy as np
from hypothesis import strategies as st

NAMES = st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "Zs")), min_size=1, max_size=12)
LAYOUT = {
    "x": ((0.0, 0.0, -0.05), (1.0, 0.0, 0.0)),
    "y1": ((0.3, 0.0, -0.05), (0.0, 1.0, 0.0)),
    "y2": ((-0.3, 0.0, -0.05), (0.0, 1.0, 0.0)),
    "z1": ((0.3, 0.3, -0.05), (0.0, 0.0, 1.0)),
    "z2": ((0.3, -0.3, -0.05), (0.0, 0.0, 1.0)),
    "z3": ((-0.3, -0.3, -0.05), (0.0, 0.0, 1.0)),
    "z4": ((-0.3, 0.3, -0.05), (0.0, 0.0, 1.0)),
}


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


@st.composite
def inertias(draw: st.DrawFn) -> dict[str, float]:
    """Inertia of three point masses about their common center of gravity: whatever they are, a mass has it."""
    points = np.array(draw(st.lists(st.tuples(*[numbers(-0.5, 0.5)] * 3), min_size=3, max_size=3)))
    points = points - points.mean(axis=0) + np.array([[0.3, 0, 0], [0, 0.3, 0], [-0.3, -0.3, 0]])
    products = points.T @ points
    total = float(np.trace(products))
    moments = {axis * 2: total - float(products[i, i]) for i, axis in enumerate("xyz")}
    return moments | {f"{'xyz'[i]}{'xyz'[j]}": float(products[i, j]) for i, j in ((0, 1), (0, 2), (1, 2))}


@st.composite
def cells(draw: st.DrawFn, name: str) -> dict[str, Any]:
    position, axis = LAYOUT[name]
    shift = draw(st.tuples(*[numbers(-0.05, 0.05)] * 3))
    stiffness = st.fixed_dictionaries({"stiffness": numbers(1e3, 1e8)})
    series = st.fixed_dictionaries({"series": st.lists(numbers(1e3, 1e8), min_size=1, max_size=3)})
    return {
        "name": name,
        "position": [p + s for p, s in zip(position, shift, strict=True)],
        "axis": list(axis),
        "full_range": draw(numbers(1.0, 1e5)),
        **draw(stiffness | series),
    }


@st.composite
def channels(draw: st.DrawFn, name: str, source: dict[str, Any]) -> dict[str, Any]:
    optional = {"lowpass": numbers(1.0, 1e3), "time_constant": numbers(0.01, 10.0), "range": numbers(0.1, 20.0)}
    own = st.fixed_dictionaries({"sensitivity": numbers(1e-6, 1.0) | numbers(-1.0, -1e-6)}, optional=optional)
    return {"name": name, **source, **draw(own)}


@st.composite
def declarations(draw: st.DrawFn) -> dict[str, Any]:
    """A sound geometry as it stands in a file."""
    bodies = st.fixed_dictionaries(
        {"mass": numbers(0.1, 1e3), "position": st.lists(numbers(-1, 1), min_size=3, max_size=3), "inertia": inertias()}
    )
    body_names = draw(st.lists(NAMES, min_size=1, max_size=3, unique=True))
    sources: dict[str, dict[str, Any]] = {f"{name}.strain": {"cell": name} for name in LAYOUT}
    declared: dict[str, Any] = {"format": "balance-geometry/1", "name": draw(NAMES), "rig": draw(NAMES)}
    declared["hub"] = draw(st.lists(numbers(-2, 2), min_size=3, max_size=3))
    declared["bodies"] = [{"name": name, **draw(bodies)} for name in body_names]
    declared["cells"] = [draw(cells(name)) for name in LAYOUT]
    if draw(st.booleans()):
        declared["torque_meter"] = {"stiffness": draw(numbers(1, 1e6)), "inertia": draw(numbers(1e-3, 10))}
        sources["torque"] = {"torque_meter": True}
    declared["channels"] = [draw(channels(name, source)) for name, source in sources.items()]
    declared["damping_ratio"] = draw(numbers(0, 0.2))
    effect = {"name": draw(NAMES), "where": [draw(NAMES)], "parameters": {draw(NAMES): draw(numbers(-1, 1))}}
    optional = {
        "tolerances": st.just({"stiffness": 0.05, "mass": 0.02}),
        "rotor": st.just({"blades": 4, "speed": 17.5}),
        "acquisition": st.just({"filter": {"type": "butterworth", "order": 6, "cutoff": 200.0}}),
        "freedom": st.lists(st.sampled_from(["x", "y", "z", "psi", "theta", "phi"]), min_size=1, unique=True),
        "effects": st.just([effect]),
    }
    return declared | draw(st.fixed_dictionaries({}, optional=optional))
