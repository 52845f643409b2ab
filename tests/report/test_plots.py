"""Plots: envelopes, markers, ticks, static pictures, and the data of the page's script."""

import base64
import json
import re
from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
import pytest

from balance_cli.report.axis_ticks import make_scale
from balance_cli.report.blocks import Chart
from balance_cli.report.data_tables import data_tables
from balance_cli.report.plot_data import chart_json
from balance_cli.report.plots import Marker, Plot, Trace, envelope, rotor_markers
from balance_cli.report.polar_picture import shorten_names
from balance_cli.report.static_plot import plot_svg, plots_svg

X = np.array([0.0, 1.0, 2.5, 4.0])


def chart(y, log=False, compact=False, x=X, **more):
    plot = Plot(
        "a <b>", x, (Trace("one", np.asarray(y, float), "#0072b2", compact=compact, **more),), "x [s]", "y [N]", log
    )
    return Chart.single("name", "caption", (plot,))


def decoded(data, index):
    entry = data["arrays"][index]
    if "u" in entry:
        return np.linspace(*entry["u"])
    if "f" in entry:
        return np.frombuffer(base64.b64decode(entry["f"]), "<f4")
    levels = np.frombuffer(base64.b64decode(entry["q"]), "<u2").astype(float)
    values = entry["a"] + entry["s"] * levels
    return np.where(levels == 65535, np.nan, np.exp(values) if entry.get("g") else values)


def first_trace(item):
    data = json.loads(chart_json(item))
    return decoded(data, data["groups"][0]["plots"][0]["traces"][0]["y"])


@pytest.mark.parametrize(
    ("compact", "log", "tolerance"), [(False, False, 1e-6), (True, False, 2e-5), (True, True, 2e-4)]
)
def test_values_survive_their_coding(compact, log, tolerance):
    y = np.geomspace(1e-3, 10.0, 4) * np.array([1.0, 1.1, 0.7, 1.0])
    y[2] = np.nan
    error = np.abs(first_trace(chart(y, log, compact)) - y)
    assert np.nanmax(error / (y if log else 10.0)) < tolerance
    assert np.isnan(first_trace(chart(y, log, compact))[2])


def test_the_data_cannot_end_their_script_element():
    assert "<" not in chart_json(chart([1.0, 2.0, 4.0, 3.0]))


def test_equal_arrays_are_sent_once():
    data = json.loads(chart_json(chart([1.0, 2.0, 4.0, 3.0], band=np.array([[1.0, 2.0, 4.0, 3.0]] * 2))))
    assert len(data["arrays"]) == 2


def test_an_envelope_keeps_every_extreme():
    y = np.random.default_rng(1).normal(size=100_003)
    x = np.arange(len(y)) / 1000.0
    short_x, short_y = envelope(x, y)
    assert len(short_x) <= 4000 and np.all(np.diff(short_x) > 0)
    assert (short_y.min(), short_y.max()) == (y.min(), y.max())
    edges = np.linspace(0, len(y), 2001).astype(int)
    for start, stop in list(pairwise(edges))[::97]:
        inside = (short_x >= x[start]) & (short_x <= x[stop - 1])
        assert short_y[inside].max() == y[start:stop].max()


def test_markers_of_the_rotor_are_named_at_blade_harmonics():
    markers = rotor_markers(17.5, 2.0, 150.0, blades=4)
    assert [(marker.x, marker.label) for marker in markers if marker.label] == [
        (17.5, "1/rev"),
        (70.0, "4/rev"),
        (140.0, "8/rev"),
    ]
    assert len(markers) == 8 and rotor_markers(0.0, 2.0, 150.0) == ()


@pytest.mark.parametrize(
    ("values", "log", "ticks"),
    [([0.0, 10.0], False, (0, 2, 4, 6, 8, 10)), ([0.2, 3.0], True, (0.2, 0.5, 1.0, 2.0)), ([3.0, 3.0], False, None)],
)
def test_ticks_are_round_numbers_inside_the_axis(values, log, ticks):
    scale = make_scale([np.array(values)], 0.0, 100.0, log)
    assert all(scale.low <= tick <= scale.high for tick in scale.ticks) and len(scale.ticks) >= 2
    if ticks:
        np.testing.assert_allclose(scale.ticks, ticks)
    assert 0.0 <= scale.at(values[0]) <= scale.at(values[1]) <= 100.0


def test_a_static_picture_is_well_formed_and_interrupted_where_values_are_missing():
    plot = Plot(
        "a <b>",
        X,
        (Trace("t", np.array([1.0, np.nan, 2.0, 3.0]), "#000000"),),
        "x",
        "y",
        markers=(Marker(1.0, "1/rev"),),
    )
    root = ElementTree.fromstring(plot_svg(plot))
    path = next(item.get("d") for item in root.iter() if item.get("stroke") == "#000000")
    assert len(re.findall("M", path)) == 2
    assert "1/rev" in "".join(root.itertext()) and "a <b>" in "".join(root.itertext())
    ElementTree.fromstring(plots_svg([plot, plot, plot]))


def test_the_data_table_has_the_values_of_the_picture():
    (table,) = data_tables(chart([1.0, 2.0, 4.5, 3.25]))
    assert [[cell.text for cell in row] for row in table.rows][2] == ["2.50000", "4.50000"]
    long = np.linspace(0.0, 360.0, 181)
    (table,) = data_tables(chart(long, x=long))
    assert len(table.rows) == 19 and "19 of 181 values" in table.caption


def test_names_in_a_legend_stay_whole_or_tell_the_runs_apart():
    assert shorten_names(["wind-hover-01", "wind-hover-02"]) == ["wind-hover-01", "wind-hover-02"]
    long = [f"2026-11-23 tunnel 3, hover at 960 rpm, point {i}" for i in (7, 8)]
    assert shorten_names(long) == ["…7", "…8"]
    different = shorten_names(["a" * 40 + "1", "b" * 40 + "2"])
    assert [len(name) for name in different] == [30, 30] and different[0].endswith("a1") and different[1][1] == "b"
