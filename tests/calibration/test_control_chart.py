"""Control chart over many calibrations: false alarms, a drift that is there, a jump, and the call."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.calibration.control_chart import control_chart
from balance_cli.calibration.gain_trend import gain_trends
from balance_cli.calibration.term_choice import LINEAR_TERMS
from balance_cli.campaign.recording.run import MemorySource
from balance_cli.cli import balance
from balance_cli.io.errors import UserError
from balance_cli.steps.calibrate import calibrate
from tests.calibration.test_load_residuals import geometry, run


@cache
def calibrated(seed: int, gain: float = 1.0):
    """A calibration; the first channel reads `gain` times as much. The load series are stated: none is searched."""
    rig = geometry()
    recorded = run(rig, seed=seed)
    block = recorded.read()
    source = MemorySource(block.channels * [gain, 1.0, 1.0], block.loads)
    series = tuple(f"load {component}" for component in range(3) for _ in range(recorded.samples // 3))
    return calibrate([replace(recorded, source=source, series_labels=series)], rig, LINEAR_TERMS)


def chart(gains, first_seed=0):
    return control_chart([(f"c{i}", calibrated(first_seed + i, gain)) for i, gain in enumerate(gains)])


def test_an_unchanged_balance_neither_drifts_nor_leaves_its_limits():
    """Twenty charts of five: 0.01 of them may drift, and 0.27 % of 9 coefficients in each be out of limits."""
    charts = [chart([1.0] * 5, 10 * i) for i in range(20)]
    assert sum(len(each.drifting_coefficients) for each in charts) <= 1
    assert sum(len(each.out_of_control) for each in charts) <= 4


def test_a_drift_of_a_gain_is_found_with_its_slope():
    """1 per mille a calibration: the slope is that of the coefficient, within four standard errors."""
    found = chart([1.0 + 1e-3 * i for i in range(6)])
    first = found.coefficients[0]
    assert (first.channel, first.term) == ("B0", "N1") and first in found.drifting_coefficients
    assert first.drift == pytest.approx(1e-3 * first.mean, abs=4 * first.drift_sigma)
    assert {each.channel for each in found.drifting_coefficients} == {"B0"}


def test_a_jump_of_the_newest_is_beyond_the_limits_of_the_earlier():
    found = chart([1.0, 1.0, 1.0, 1.0, 1.02])
    assert ("B0", "N1") in {(each.channel, each.term) for each in found.out_of_control}
    assert {each.channel for each in found.out_of_control} == {"B0"}


def test_scatter_beyond_the_errors_widens_the_limits():
    """Gains that scatter by 1 %: that is no drift, the scatter is significant, and 1 % more is within the limits."""
    found = chart([1.0, 1.012, 0.991, 1.008, 0.993, 1.01])
    own = next(each for each in found.coefficients if (each.channel, each.term) == ("B0", "N1"))
    assert own.scatter_p < 1e-6
    assert own not in found.drifting_coefficients and not own.is_out_of_control


def test_two_calibrations_tell_no_drift():
    assert np.isnan([each.drift_p for each in chart([1.0, 1.1]).coefficients]).all()


def test_other_balances_are_refused():
    made = calibrated(1)
    model = replace(made.all_trims.model, components=("a", "b", "c"))
    other = replace(made, all_trims=replace(made.all_trims, model=model))
    with pytest.raises(UserError, match="has the components a, b, c"):
        control_chart([("o", other), ("n", made)])


def test_the_call(tmp_path):
    """Three older calibrations and a new one whose first channel reads 3 % more."""
    rng = np.random.default_rng(5)
    ramp = np.array([0.0, 0.5, 1.0, 0.5, 0.0, -0.5, -1.0, -0.5, 0.0])
    loads = np.vstack([np.outer(ramp, [100.0, 0.0]), np.outer(ramp, [0.0, 400.0])])
    C = np.array([[1e-5, 2e-7], [3e-7, 4e-6]])

    def call(number, gain, *words, status=0):
        readings = loads @ C.T * [gain, 1.0] + 1e-7 * rng.normal(size=loads.shape)
        rows = "\n".join(",".join(f"{v:.9g}" for v in row) for row in np.hstack([loads, 1e3 * readings]))
        (tmp_path / "p.csv").write_text("Fx [N],Fz [N],B1 [mV/V],B2 [mV/V]\n" + rows + "\n")
        files = ["-o", tmp_path / f"{number}.h5", "--json", tmp_path / "j.json"]
        result = CliRunner().invoke(balance, [str(word) for word in ("calibrate", tmp_path / "p.csv", *files, *words)])
        assert result.exit_code == status, result.output
        return result.output

    for number in range(3):
        call(number, 1.0)
    old = [word for number in range(3) for word in ("--against", tmp_path / f"{number}.h5")]
    text = call(3, 1.03, *old)
    assert "Control chart of 4 calibrations" in text and "B1 Fx" in text
    summary = json.loads((tmp_path / "j.json").read_text())
    assert summary["against"]["calibration"] == "2.h5"
    made = summary["control_chart"]
    assert made["calibrations"] == ["0.h5", "1.h5", "2.h5", "3.h5"]
    row = next(each for each in made["coefficients"] if (each["channel"], each["term"]) == ("B1", "Fx"))
    assert row["out_of_control"] and len(row["values"]) == 4 and row["unit"] == "V/V"
    call(4, 1.0, "--against", tmp_path / "0.h5")
    assert json.loads((tmp_path / "j.json").read_text())["control_chart"] is None
    twice = ["--against", tmp_path / "0.h5", "--against", tmp_path / "0.h5"]
    assert "is given twice" in call(5, 1.0, *twice, status=2)


def test_a_gain_that_rises_beside_scatter_is_named_in_a_sentence():
    """0.3 % a calibration beside gains that scatter by 0.05 %: single coefficients have two degrees of freedom."""
    rng = np.random.default_rng(7)
    mean = np.eye(6) + 0.05 * rng.normal(size=(6, 6))

    def trends(slope, scatter=5e-4, n=4):
        gains = 1.0 + scatter * rng.normal(size=(n, 6))
        gains[:, 2] += slope * np.arange(n)
        values = gains[:, None, :] * mean + 1e-5 * rng.normal(size=(n, 6, 6))
        return gain_trends(list("abcdef"), values, np.full(values.shape, 1e-10))

    named = [trends(3e-3) for _ in range(20)]
    assert sum(bool(each) and each[0].channel == "c" for each in named) >= 19
    trend = trends(3e-3, 1e-4)[0]
    assert trend.slope == pytest.approx(3e-3, rel=0.1)
    assert trend.sentence.startswith("c: its gain for all loads rises by 0.31 % a calibration, +0.92 % over all 4")
    assert sum(bool(trends(0.0)) for _ in range(200)) <= 6
    assert trends(3e-3, n=2) == ()
    assert [each.channel for each in chart([1.0, 1.003, 1.006, 1.009]).gain_trends] == ["B0"]
