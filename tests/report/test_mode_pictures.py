"""Mode shapes on the rig: displacements of its points, and the assurance of two models' shapes."""

import re
from dataclasses import replace

import numpy as np

from balance_cli.model.balance import balance_model
from balance_cli.report import summary
from balance_cli.report.blocks import WarningText
from balance_cli.report.mode_pictures import assurance_table, point_shapes, shape_picture
from balance_cli.report.polar_picture import polar_picture
from balance_cli.report.rig_drawing import draw_rig
from balance_cli.report.sources import group_sources
from tests.support.report_content import campaign, loads, model


def test_points_move_with_the_plate_as_a_rigid_body():
    made = model()
    drawing = draw_rig(made.geometry)
    names, points = drawing.names, drawing.points
    shapes = point_shapes(made).points
    center = balance_model(made.geometry).system().equations.center.value
    assert shapes.shape == (len(made.modes.frequency), len(names), 3) and names[-1] == "hub"
    for shape, q in zip(shapes, made.modes.shape[:, :6], strict=True):
        rotation = np.array([q[5], q[4], q[3]])  # phi, theta, psi turn about x, y, z
        np.testing.assert_allclose(shape, q[:3] + np.cross(rotation, points - center), atol=1e-12)


def test_a_model_agrees_with_itself_and_the_animation_closes():
    sources = group_sources(campaign()).models
    table = assurance_table(sources[0], sources[0])
    shaft = [i for i, row in enumerate(table.rows) if row[1 + i].text == "–"]
    assert len(shaft) == 1  # the plate is at rest in the mode of the torque meter
    others = [row[1 + i] for i, row in enumerate(table.rows) if i not in shaft]
    assert {(cell.text, cell.mark) for cell in others} == {("1.00", "good")}
    frames = re.search(r'values="([^"]*)"', shape_picture(sources[0]).markup).group(1).split(";")
    assert frames[0] == frames[-1] != frames[3]


def test_a_vector_of_the_polar_plot_points_along_its_phase():
    run = loads().runs["wind-1"]
    markup = polar_picture({"wind-1": run}, 3, "a").markup
    x, y = map(float, re.search(r'<circle cx="([\d.]+)" cy="([\d.]+)" r="[\d.]+"><title>', markup).groups())
    value = run.amplitude[1, 0]
    sigma = max(run.sigma_cosine[1, 0], run.sigma_sine[1, 0])
    radius = 62.0 * abs(value) / (abs(value) + sigma)  # the circle of one sigma about the point is within the plot
    angle = np.angle(value)
    np.testing.assert_allclose([x - 85.0, 85.0 - y], radius * np.array([np.cos(angle), np.sin(angle)]), atol=0.06)
    assert "Fx 3/rev" in markup and "Mz 1/rev" in markup


def test_models_of_different_rigs_have_no_assurance_and_the_page_warns():
    first = group_sources(campaign()).models[0]
    geometry = first.content.geometry
    renamed = tuple(cell.model_copy(update={"name": f"other {cell.name}"}) for cell in geometry.cells)
    other = geometry.model_copy(update={"rig": "other rig", "cells": renamed})
    content = replace(first.content, geometry=other)
    second = replace(first, content=content)
    assert assurance_table(first, second) is None
    warned = summary.section(replace(group_sources(campaign()), models=(first, second))).blocks[0]
    assert isinstance(warned, WarningText) and "different rigs" in warned.text and "other rig" in warned.text
