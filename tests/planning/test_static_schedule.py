"""Static schedules: D-optimal designs of closed form, aliased terms, and a calibration of the plan's own points."""

import json

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from balance_cli.cli import balance
from balance_cli.io.errors import UserError
from balance_cli.planning.static_schedule import one_load_at_a_time, plan_static_schedule
from balance_cli.simulation.files import read_plan
from balance_cli.simulation.statics import static_load_points
from tests.support.rigs import CONFIGS

SIX = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")


def test_linear_schedule_reaches_the_bound_of_hadamard():
    # Two loads at +-1 on two components: det X'X of 4 points is at most 4^3, reached by the factorial design.
    schedule = plan_static_schedule(("Fx", "Fy"), (1.0, 1.0), 4, "linear", 2)
    X = np.column_stack([np.ones(4), schedule.optimal.points])
    assert np.linalg.det(X.T @ X) == pytest.approx(64.0)
    assert schedule.optimal.sigma == pytest.approx([0.5, 0.5])


def test_quadratic_terms_of_one_load_have_the_known_optimum():
    # A third of the points at each of -1, 0 and 1 (Kiefer and Wolfowitz, 1960).
    schedule = plan_static_schedule(("Fx",), (1.0,), 9, "quadratic", 1)
    assert sorted(schedule.optimal.points[:, 0]) == [-1.0] * 3 + [0.0] * 3 + [1.0] * 3


def test_one_load_at_a_time_cannot_tell_products():
    schedule = plan_static_schedule(SIX, (1.0,) * 6, 60, "quadratic", 2)
    assert set(schedule.one_at_a_time.aliased) == {name for name in schedule.terms if " " in name}
    assert not schedule.optimal.aliased and np.isfinite(schedule.optimal.sigma).all()
    assert schedule.efficiency > 2.0
    assert len(schedule.optimal.points) == len(schedule.one_at_a_time.points) == 60
    assert np.count_nonzero(schedule.optimal.points, axis=1).max() <= 2


def test_all_terms_are_told_by_enough_points():
    schedule = plan_static_schedule(("Fx", "Fz", "My"), (1.0,) * 3, 60, "all", 2)
    assert not schedule.optimal.aliased


def test_one_load_at_a_time_has_as_many_points_as_asked():
    for points in (7, 13, 40, 61):
        x = one_load_at_a_time(6, points)
        assert x.shape == (points, 6) and np.count_nonzero(x, axis=1).max() == 1 and np.abs(x).max() == 1.0


@pytest.mark.parametrize("points", [5, 5000])
def test_impossible_numbers_of_points_are_refused(points):
    with pytest.raises(UserError, match="points are not"):
        plan_static_schedule(SIX, (1.0,) * 6, points, "quadratic", 2)


def test_static_plan_is_one_of_simulate(tmp_path):
    hall = {"format": "balance-hall/1", "static_loads": {"Fx": 800.0, "Fz": 3500.0, "My": 400.0}}
    (tmp_path / "hall.yaml").write_text(yaml.safe_dump(hall))
    words = ["plan", "-g", CONFIGS / "rts-6.yaml", "--hall", tmp_path / "hall.yaml", "--points", 20]
    words += ["-o", tmp_path / "plan.yaml", "--json", tmp_path / "s.json"]
    result = CliRunner().invoke(balance, list(map(str, words)))
    assert result.exit_code == 0, result.output
    (run,) = read_plan(tmp_path / "plan.yaml").runs
    rows = static_load_points(run)
    assert rows.shape == (21, 6) and not rows[0].any()
    assert np.abs(rows).max(axis=0) == pytest.approx([800.0, 0.0, 3500.0, 0.0, 400.0, 0.0])
    summary = json.loads((tmp_path / "s.json").read_text())
    assert summary["points"] == 20 and len(summary["one_at_a_time"]["aliased"]) == 3
    refused = CliRunner().invoke(balance, [*map(str, words), "--minutes", "5"])
    assert refused.exit_code == 2 and "--minutes" in refused.output
