"""The review of a load schedule against counts by hand and closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.calibration.load_schedule import components_of_one_series, review_load_schedule
from balance_cli.calibration.term_choice import LINEAR_TERMS
from balance_cli.cli.calibration_text import calibration_text
from balance_cli.report.blocks import BulletList
from balance_cli.report.load_schedule import load_schedule_blocks
from balance_cli.steps.calibrate import calibrate
from tests.calibration.test_load_residuals import FULL, geometry, run


@pytest.fixture(scope="module")
def calibration():
    """Nine points of each of three loads, one load at a time."""
    return calibrate([run(geometry())], geometry(), choice=LINEAR_TERMS)


def test_counts_of_one_load_at_a_time(calibration) -> None:
    schedule = review_load_schedule(calibration.all_trims, np.repeat([0, 1, 2], 9))
    assert schedule.applied.tolist() == schedule.alone.tolist() == [6, 6, 6]
    assert schedule.levels.tolist() == [5, 5, 5]
    assert schedule.series.tolist() == [1, 1, 1]
    assert schedule.combined == 1
    assert schedule.load_sum == pytest.approx(1.0)
    assert schedule.largest == pytest.approx(FULL)
    assert schedule.condition == pytest.approx(1.0)
    assert schedule.inflation == pytest.approx([1, 1, 1])
    text = " ".join(schedule.open_questions)
    assert "Never applied together, so that their interaction is not known: N1 N2, N1 A, N2 A." in text
    assert "A is varied in one load series only" in text
    assert "No check loads were held out" in text


def test_the_text_names_loads_that_no_other_series_confirms(calibration) -> None:
    """A series of N1 confirms N1; an old artefact has no series, and a single series is no comparison."""
    all_trims = calibration.all_trims
    assert components_of_one_series(all_trims) == ("N1", "N2", "A")
    lines = [line for line in calibration_text(calibration) if "in one load series only" in line]
    assert len(lines) == 1
    assert lines[0].startswith("  N1, N2, A: ")
    twice = np.repeat([0, 1, 2], 9)
    twice[4:9] = 3
    assert components_of_one_series(replace(all_trims, load_series=twice)) == ("N2", "A")
    for numbers in (None, np.zeros(27, np.intp)):
        assert components_of_one_series(replace(all_trims, load_series=numbers)) == ()


def test_inflation_of_two_correlated_loads(calibration) -> None:
    """Two loads of correlation r inflate each other's variance by 1/(1 - r^2), and the condition is as below."""
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 27))
    loads = np.column_stack([a, a + 0.2 * b, rng.normal(size=27)]) * 10
    made = replace(calibration.all_trims, loads=loads)
    schedule = review_load_schedule(made, np.zeros(27, np.intp))
    centered = loads - loads.mean(axis=0)
    r = np.corrcoef(centered.T)
    assert schedule.correlation == pytest.approx(r)
    assert schedule.inflation == pytest.approx(np.diag(np.linalg.inv(r)))
    assert schedule.condition == pytest.approx(np.sqrt(np.linalg.cond(r)))
    assert "is nearly a combination of the other loads" in " ".join(schedule.open_questions)


def test_one_sided_loads_and_rows_that_no_other_series_predicts(calibration) -> None:
    all_trims = calibration.all_trims
    lost = np.full_like(all_trims.cross_validation_errors, np.nan)
    model = replace(all_trims.model, smallest_load=np.zeros(3))
    made = replace(all_trims, model=model, cross_validation_errors=lost)
    text = " ".join(review_load_schedule(made, np.repeat([0, 1, 2], 9)).open_questions)
    assert "N1 was loaded upwards only" in text
    assert "27 of 27 rows cannot be predicted by the other load series" in text


def test_the_page_says_what_the_schedule_cannot_tell(calibration) -> None:
    blocks = list(load_schedule_blocks(calibration))
    assert blocks[0].text == "Load schedule"
    assert any(isinstance(block, BulletList) for block in blocks)
    assert list(load_schedule_blocks(replace(calibration, all_trims=None))) == []
