"""Back-calculated loads against closed forms, rated loads as full scale, and what text, JSON and page say of them."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.calibration.load_method import LINEAR, NON_ITERATIVE
from balance_cli.calibration.load_residuals import load_residuals
from balance_cli.calibration.term_choice import LINEAR_TERMS
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.geometry_file import geometry_from_dict
from balance_cli.cli.calibration_summary import calibration_summary
from balance_cli.cli.calibration_text import calibration_text
from balance_cli.report.blocks import pictures
from balance_cli.report.calibration import section
from balance_cli.steps.calibrate import calibrate
from tests.report.test_math_model import given

COMPONENTS = [
    {"name": "N1", "direction": [0, 0, -1], "position": [0.1, 0, 0]},
    {"name": "N2", "direction": [0, 0, -1], "position": [-0.1, 0, 0]},
    {"name": "A", "direction": [-1, 0, 0]},
]
FULL = np.array([200.0, 300.0, 50.0])
C = np.array([[1.0, 0.1, 0.0], [0.05, 1.1, 0.02], [0.01, -0.03, 0.9]]) * 1e-3 / FULL


def geometry(**keys):
    base = {"format": "balance-geometry/1", "name": "g", "rig": "r", "components": COMPONENTS}
    return geometry_from_dict({**base, "channels": [{"name": f"B{i}", "unit": "mV/V"} for i in range(3)], **keys})


def run(rig, seed=1, noise=1e-6, name="cal") -> Run:
    """Each component up, down and to the other side, with noise on the readings."""
    from balance_cli.campaign.rig.load_components import load_components

    steps = np.array([0, 0.5, 1, 0.5, 0, -0.5, -1, -0.5, 0])
    x = np.vstack([np.outer(steps, np.eye(3)[j]) for j in range(3)]) * FULL
    readings = x @ C.T + noise * np.random.default_rng(seed).normal(size=x.shape)
    source = MemorySource(readings, x @ load_components(rig).to_hub)
    return Run(name, rig.rig, "static", ("B0", "B1", "B2"), len(x), source, trim="t")


@pytest.fixture(scope="module")
def calibration():
    rig = geometry(rated_loads={"N1": 400.0, "A": 100.0})
    return calibrate([run(rig)], rig, choice=LINEAR_TERMS, hold_out=[run(rig, seed=2, name="again")])


def test_they_are_the_noise_of_the_readings_as_loads(calibration) -> None:
    """Standard deviation: noise through the inverse of C; 24 degrees of freedom tell it to 15 %."""
    residuals = load_residuals(calibration)
    assert residuals.method == LINEAR
    expected = 1e-6 * np.linalg.norm(np.linalg.inv(C), axis=1)
    assert residuals.standard_deviation == pytest.approx(100 * expected / residuals.full_scale.values, rel=0.45)
    largest, at = residuals.largest
    assert largest == pytest.approx(residuals.percent[at, range(3)])
    assert np.nanmax(np.abs(residuals.percent), axis=0) == pytest.approx(np.abs(largest))


def test_full_scale_is_the_rated_load_where_declared(calibration) -> None:
    scale = load_residuals(calibration).full_scale
    assert scale.values == pytest.approx([400.0, 300.0, 100.0])
    assert scale.is_rated == (True, False, True)
    trim = calibration.trims["t"]
    assert trim.residual_percent_fs["N1"] == pytest.approx(100 * trim.residual[0] / 400.0)
    text = "\n".join(calibration_text(calibration))
    assert "in % of rated load, or calibrated range where none is declared, by the linear model" in text
    assert "300 N " in text


def test_summary_has_every_point(calibration) -> None:
    summary = calibration_summary(calibration)
    residuals = summary["load_residuals"]
    assert len(residuals["points"]) == 27
    assert residuals["points"][4]["point"] == "cal row 5"
    assert residuals["is_rated_load"]["N2"] is False
    points = summary["check_points"]["again"]
    assert len(points) == 27
    inside = [
        abs(c - a) <= i for p in points for c, a, i in zip(p["computed"], p["applied"], p["interval"], strict=True)
    ]
    assert np.mean(inside) > 0.85


def test_the_page_opens_with_them(calibration) -> None:
    made = section(given(calibration))
    assert [picture.name for picture in pictures(made.blocks)][:2] == ["calibration-loads", "calibration-check-1"]
    assert made.blocks[0].text == "Back-calculated load residuals"
    assert "ratios to the excitation" in str(made.blocks)


def test_the_non_iterative_method_is_named_where_it_is_used() -> None:
    rig = geometry()
    made = calibrate([run(rig)], rig, choice=LINEAR_TERMS, non_iterative=True)
    assert load_residuals(made).method == NON_ITERATIVE


def test_excluded_rows_and_matrices_have_none(calibration) -> None:
    all_trims = calibration.all_trims
    spoiled = all_trims.residuals.copy()
    spoiled[3] = np.nan
    residuals = load_residuals(replace(calibration, all_trims=replace(all_trims, residuals=spoiled)))
    assert not residuals.used[3]
    assert residuals.used.sum() == 26
    assert load_residuals(replace(calibration, all_trims=None)) is None
