"""Mean loads of the size of a trim and the opposite sign are named and flagged; other loads and signs are not."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.reduction.result import RunLoads
from balance_cli.steps.contradicted_loads import compare_loads

RANGE = np.array([800.0, 800.0, 3700.0, 400.0, 400.0, 450.0])
TRIM = np.array([0.0, 0.0, 2500.0, 0.0, 0.0, 250.0])


def trim(name, mean_load):
    return SimpleNamespace(trim=name, components=COMPONENTS, mean_load=mean_load, calibrated_range=RANGE)


CALIBRATION = SimpleNamespace(trims={"bare": trim("bare", 0.0 * TRIM), "hover": trim("hover", TRIM)})


def a_run(mean, sigma=1.0, kind="wind", name="wind-1"):
    amplitude = np.zeros((3, 6), complex)
    amplitude[0] = mean
    return RunLoads(
        run=name,
        kind=kind,
        response="model",
        trim="hover",
        components=COMPONENTS,
        frequency_hz=17.5 * np.arange(3),
        amplitude=amplitude,
        sigma_cosine=np.full((3, 6), sigma),
        sigma_sine=np.full((3, 6), sigma),
        flags=(("",) * 6,) * 3,
        redundancy=np.ones(3),
        redundancy_limit=np.full(3, 3.0),
        condition=np.ones(3),
        left_out={},
        interval=(0.0, 10.0),
    )


def compared(*runs, calibration=CALIBRATION):
    """The warnings, and the components of each run that are flagged."""
    flagged, warnings = compare_loads({run.run: run for run in runs}, calibration)
    hit = {
        name: {component for row in run.flags for component, word in zip(COMPONENTS, row, strict=True) if word}
        for name, run in flagged.items()
    }
    return warnings, hit


MEAN = np.array([109.0, -62.0, 2833.0, 56.0, -38.0, 276.0])


def test_all_wind_runs_reversed_are_named_by_the_trim():
    warnings, hit = compared(a_run(-MEAN), a_run(-1.2 * MEAN, name="wind-2"))
    assert [text.partition(":")[0] for text in warnings] == ["wind-1", "wind-2"]
    assert all("mean Fz, Mz of the size of trim `hover`" in text and "all channels" in text for text in warnings)
    assert hit == {"wind-1": set(COMPONENTS), "wind-2": set(COMPONENTS)}


def test_a_reversed_torque_alone_is_named():
    (text,), hit = compared(a_run(MEAN * [1, 1, 1, 1, 1, -1]))
    assert text.startswith("wind-1: mean Mz of the size") and hit == {"wind-1": {"Mz"}}


@pytest.mark.parametrize(
    "run",
    [
        a_run(MEAN),
        a_run(MEAN * [-1, -1, 1, -1, -1, 1]),
        a_run(-0.3 * MEAN),
        a_run(-MEAN * [1, 1, 1, 1, 1, 0.1]),
        a_run(-MEAN, sigma=1e3),
        a_run(np.full(6, np.nan)),
        a_run(-MEAN, kind="check"),
    ],
    ids=["sound", "other loads", "smaller", "other torque", "unclear", "not measured", "check"],
)
def test_other_loads_are_not(run):
    assert compared(run) == ((), {"wind-1": set()})


def test_neither_without_a_loaded_trim_nor_with_trims_of_both_signs():
    reversed_run = a_run(-MEAN)
    assert compared(reversed_run, calibration=None)[0] == ()
    both = SimpleNamespace(trims={"hover": trim("hover", TRIM), "dive": trim("dive", -TRIM)})
    assert compared(reversed_run, calibration=both)[0] == ()
    part = replace(reversed_run, components=COMPONENTS[:5], amplitude=reversed_run.amplitude[:, :5])
    assert compare_loads({"wind-1": part}, CALIBRATION)[1] == ()
