"""One load gain in all components: a doubt that the runs cannot settle, not an explanation."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.diagnosis.common_load_gain import common_load_gain, judge_common_load_gain
from balance_cli.diagnosis.result import EXPLAINED, PARTLY_EXPLAINED
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.estimation.measured_spectra import Spectra, measured_spectra
from balance_cli.model.fitted_effects import FittedParameter
from balance_cli.model.system_response import load_response
from balance_cli.reduction.gain_error import add_gain_error
from balance_cli.reduction.mean_loads import MeanLoads
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from balance_cli.simulation.preset_plans import static_plans
from balance_cli.steps.identify import IdentifyOptions, identify
from tests.support.diagnosis_content import delay_effect, diagnosis
from tests.support.report_content import model
from tests.support.rigs import rotor_balance

RIG = rotor_balance()
SETTINGS = DEFAULT_SETTINGS.data_tests.common_load_gain
SWEPT = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")


def gains(values, sigma=1e-5):
    return tuple(
        replace(
            delay_effect(),
            name="load-gain",
            where=(name,),
            parameters=(FittedParameter("gain", value, sigma, "1"),),
        )
        for name, value in values.items()
    )


@pytest.fixture(scope="module")
def spectra():
    sweeps = tuple(SweepPlan(run=f"sweep-{name}", excited=(name,), level=(20.0,), periods=3) for name in SWEPT)
    plan = CampaignPlan(runs=(*static_plans(), *sweeps))
    return measured_spectra(simulate_campaign(true_rig(RIG), plan, seed=5).runs, RIG)


def test_one_gain_of_all_swept_components_is_no_explanation(spectra):
    swept = {name for run in spectra.lines for name in run.components}
    assert spectra.statics
    effects = gains({name: 0.9901 + 1e-6 * i for i, name in enumerate(sorted(swept))})
    found = replace(diagnosis(EXPLAINED), effects=effects)
    judged, updated = judge_common_load_gain(found, model(), spectra, SETTINGS)
    assert judged.verdict == PARTLY_EXPLAINED
    assert "one factor, 0.9901" in judged.notes[-1]
    assert "off by 1 %" in judged.notes[-1]
    assert updated.gain_error == pytest.approx(0.0100, abs=1e-4)


def test_the_error_of_the_gain_is_in_sigma_of_all_loads():
    doubted = identify(Spectra((), (), (), {}), RIG, IdentifyOptions(method="computed"))
    exact, source = (ModelSource(replace(doubted, gain_error=error)) for error in (None, 0.01))
    loads = np.array([[0.0, 0.0, 3.0, 0.0, 4.0, 0.0]], complex)
    f = np.array([20.0])
    added = np.diag((source.covariance(f, 0.0, loads) - exact.covariance(f, 0.0, loads))[0])
    read = load_response(source.system, f)[0] @ loads[0]
    assert np.sqrt(added) == pytest.approx(0.01 * np.abs(np.concatenate([read.real, read.imag])), abs=1e-9)
    values = np.array([100.0, 0.0, 0.0, 0.0, 0.0, -20.0])
    mean = MeanLoads(SWEPT, values, np.full(6, 0.1), "bare", ("",) * 6, 1.0, 2.0, 3.0)
    assert add_gain_error(mean, exact) is mean
    widened = add_gain_error(mean, source)
    assert widened.sigma == pytest.approx([np.hypot(0.1, 1.0), 0.1, 0.1, 0.1, 0.1, np.hypot(0.1, 0.2)])
    assert "may differ by 1 %" in widened.note


@pytest.mark.parametrize(
    "values",
    [
        {"Fx": 0.99, "Fy": 0.99},  # one force cell may serve two components
        {"Fx": 0.99, "Fy": 1.02, "Fz": 0.97, "Mx": 1.005, "My": 0.98, "Mz": 0.96},
    ],
)
def test_load_gains_of_single_exciters_stay_what_they_are(spectra, values):
    found = replace(diagnosis(EXPLAINED), effects=gains(values))
    before = model()
    assert judge_common_load_gain(found, before, spectra, SETTINGS) == (found, before)


def test_without_static_runs_nothing_is_compared(spectra):
    alone = Spectra(spectra.lines, (), {}, {})
    assert common_load_gain(gains(dict.fromkeys(SWEPT, 0.99)), alone, SETTINGS) is None
