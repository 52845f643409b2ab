"""One small simulated campaign for all tests, integrated in time: the truth that the chain is held to."""

import os
from dataclasses import dataclass, replace

# The matrices are many and small: threads in BLAS cost more than they bring. Before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

# Files with the longest tests, by time. Begun first, so that no worker ends on one of them alone.
LONGEST_FILES = (
    "tests/model/test_effects.py",
    "tests/diagnosis/test_diagnosis.py",
    "tests/diagnosis/test_silverbox.py",
    "tests/diagnosis/test_nonlinear_effects.py",
    "tests/signals/local/test_models.py",
    "tests/diagnosis/test_emps.py",
    "tests/calibration/test_tares.py",
    "tests/diagnosis/test_zero_drift.py",
    "tests/signals/local/test_tones.py",
    "tests/steps/test_reduce_in_time.py",
    "tests/test_tutorial.py",
    "tests/test_chain.py",
    "tests/signals/test_single_force.py",
    "tests/test_docs.py",
    "tests/cli/test_diagnose_command.py",
    "tests/test_readme.py",
    "studies/tests/test_blind.py",
)

# The same examples in every run: a failure is found again, and what passes here passes elsewhere. No limit of time: a
# busy machine is no fault of the code.
settings.register_profile("seeded", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("seeded")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Whole files for each worker: what the tests of a file share is made once, not by every worker."""
    from xdist.scheduler import LoadFileScheduling

    if config.getvalue("dist") != "load":
        return None
    config.option.loadscopereorder = False
    return LoadFileScheduling(config, log)


def pytest_collection_modifyitems(items):
    """The files with the longest tests first, all others in their order."""
    place = {name: at for at, name in enumerate(LONGEST_FILES)}
    items.sort(key=lambda item: place.get(item.nodeid.partition("::")[0], len(place)))


@dataclass(frozen=True)
class SimulatedCampaign:
    """A rig drawn from the tolerances, its runs, and the truth of each."""

    geometry: object
    rig: object
    runs: tuple
    truths: dict

    def runs_of_kind(self, *kinds):
        return tuple(run for run in self.runs if run.kind in kinds)


@pytest.fixture(scope="session")
def campaign():
    from balance_cli.simulation import draw_rig, short_plan, simulate_campaign
    from tests.support.rigs import rotor_balance

    geometry = rotor_balance()
    rig = draw_rig(geometry, np.random.default_rng(11))
    # A mode of a tenth of a per cent would ring through the whole of so short a record.
    rig = replace(rig, damping_ratios=np.maximum(rig.damping_ratios, 0.008))
    plan = short_plan()
    longer = [
        run_plan.model_copy(update={"periods": 8}) if run_plan.kind == "sweep" else run_plan for run_plan in plan.runs
    ]
    longer = [
        run_plan.model_copy(update={"duration": 16.0}) if run_plan.kind in ("check", "wind") else run_plan
        for run_plan in longer
    ]
    steps = [run_plan.model_copy(update={"steps": 5}) if run_plan.kind == "static" else run_plan for run_plan in longer]
    runs, truths = simulate_campaign(rig, plan.model_copy(update={"runs": tuple(steps)}), seed=4)
    return SimulatedCampaign(geometry, rig, runs, {truth.name: truth for truth in truths})


@pytest.fixture(scope="session")
def identified(campaign):
    from balance_cli.estimation.measured_spectra import measured_spectra
    from balance_cli.steps.identify import identify

    return identify(measured_spectra(campaign.runs, campaign.geometry), campaign.geometry)


@pytest.fixture(scope="session")
def calibration(campaign):
    from balance_cli.steps.calibrate import calibrate

    return calibrate(campaign.runs_of_kind("static"), campaign.geometry)
