"""Pictures about modes and rotor speed: Campbell diagram, Nyquist plots, whiteness of innovations, the rig."""

import re
from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.estimation.identified_model import identified_system
from balance_cli.model.modes import modes
from balance_cli.report.campbell import campbell_blocks, eigenfrequencies
from balance_cli.report.figure_style import PlotStyle
from balance_cli.report.force_responses import Curve
from balance_cli.report.mode_pictures import point_shapes
from balance_cli.report.nyquist import mode_loops, nyquist_picture
from balance_cli.report.response_figures import Panel
from balance_cli.report.rig_drawing import draw_rig, rig_picture
from balance_cli.report.sources import group_sources
from tests.support.other_rigs import RIGS, other_rig
from tests.support.report_content import campaign, model


def spinning(polar_inertia: float):
    """The sample model with a gyroscopic rotor."""
    effect = DeclaredEffect(name="gyroscopic-coupling", parameters={"polar_inertia": polar_inertia})
    geometry = model().geometry.model_copy(update={"effects": (effect,)})
    made = model(geometry=geometry)
    table = made.parameters
    value = np.append(table.value, polar_inertia)
    zeros = np.zeros(1)
    table = replace(
        table,
        names=(*table.names, "gyroscopic-coupling.polar_inertia"),
        units=(*table.units, "kg m2"),
        value=value,
        sigma=np.append(table.sigma, zeros),
        declared=np.append(table.declared, polar_inertia),
        declared_sigma=np.append(table.declared_sigma, zeros),
        informed_by=(*table.informed_by, "exact"),
    )
    return replace(made, parameters=table, covariance=np.diag(table.sigma**2))


def test_modes_are_followed_over_speed():
    """The first two modes are nearly symmetric bending modes: a spinning rotor drives them apart."""
    made = spinning(2.0)
    speeds = np.linspace(0.0, 40.0, 9)
    tracks = eigenfrequencies(made, speeds)
    system = identified_system(made)
    for speed, row in zip(speeds, tracks, strict=True):
        np.testing.assert_allclose(np.sort(row), np.sort(modes(system, float(speed)).frequency), rtol=1e-9)
    assert np.ptp(tracks, axis=0).max() > 0.2
    # A track has no jump: each step is small against the distance of modes.
    assert np.abs(np.diff(tracks, 2, axis=0)).max() < 0.5
    at_rest = eigenfrequencies(model(), speeds)
    assert np.all(at_rest == at_rest[0])


def test_the_campbell_diagram_names_the_nearest_multiple():
    source = next(item for item in group_sources(campaign()).models if item.role == "identified")
    chart, table = campbell_blocks(source, (17.2,))
    (plot,) = chart.groups[0].plots
    ray = next(trace for trace in plot.traces if trace.label == "3/rev")
    np.testing.assert_allclose(ray.y, 3 * plot.x)
    speed = source.content.geometry.rotor.speed
    assert [marker.x for marker in plot.markers] == [speed, 17.2]
    for row, frequency, zeta in zip(
        table.rows, source.content.modes.frequency, source.content.modes.damping_ratio, strict=True
    ):
        n = int(row[1].text.removesuffix("/rev"))
        assert abs(n * speed - frequency) <= speed / 2 or n == 1
        bandwidths = abs(n * speed - frequency) / (2 * zeta * frequency)
        assert float(row[3].text) == pytest.approx(bandwidths, rel=0.06)
        assert (row[3].mark == "bad") == (bandwidths < 1.0)
    resting = source.content.geometry.model_copy(update={"rotor": None})
    assert not list(campbell_blocks(replace(source, content=replace(source.content, geometry=resting)), ()))


def receptance(f0: float, zeta: float, f):
    return 1.0 / (1.0 - (f / f0) ** 2 + 2j * zeta * f / f0)


def test_each_mode_has_its_circle_where_it_is_seen_best():
    """Two single resonances in two sensors: each mode takes the sensor that resonates."""
    source = group_sources(campaign()).models[0]
    table = source.content.modes
    table = replace(table, frequency=np.array([20.0, 50.0, 400.0]), damping_ratio=np.array([0.01, 0.02, 0.01]))
    made = replace(source.content, modes=table)
    f = np.arange(5.0, 100.0, 0.1)
    low, high = receptance(20.0, 0.01, f), receptance(50.0, 0.02, f)
    noise = np.full(len(f), 1e-3)
    panels = [Panel(name, "Fz", Curve(f, value, noise), ()) for name, value in (("a", low + 0.01 * high), ("b", high))]
    loops = list(mode_loops(made, panels))
    assert [(loop.frequency, loop.panel.sensor) for loop in loops] == [(20.0, "a"), (50.0, "b")]
    # The receptance of one mode is a circle of diameter 1/(2 zeta) but for terms of the order of zeta.
    value = loops[1].measured.value
    center = -0.25j / 0.02
    np.testing.assert_allclose(np.abs(value - center), 0.25 / 0.02, rtol=0.03)
    exact = {"a": (20.0, 0.01), "b": (50.0, 0.02)}
    picture = nyquist_picture(
        replace(source, content=made),
        panels,
        lambda label, panel, frequency: receptance(*exact[panel.sensor], frequency),
        [("m", PlotStyle("#0072b2"))],
    )
    assert picture.markup.count("<svg") == 2 and "50.00 Hz, b/Fz" in picture.markup
    assert not list(mode_loops(made, [Panel("a", "Fz", Curve(f[:30], low[:30], noise[:30]), ())]))


@pytest.mark.parametrize("letter", RIGS)
def test_every_rig_can_be_drawn(letter):
    geometry = other_rig(letter)
    drawing = draw_rig(geometry)
    assert drawing.points.shape == (len(geometry.cells) + 1, 3) and drawing.ground.shape == (len(geometry.cells), 3)
    numbers = [float(text) for text in re.findall(r"[ML]([-\d.]+) ", rig_picture(geometry).markup)]
    assert numbers and np.isfinite(numbers).all() and min(numbers) >= 0


def test_what_the_cells_stand_on_moves_only_where_it_is_flexible():
    assert np.all(point_shapes(model()).ground == 0)
