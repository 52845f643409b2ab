"""A load point that is labeled as a tare and has a load is named; zeros with noise, hangers and trims are not."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.recording.loaded_tares import describe_loaded_tares
from balance_cli.diagnosis.consistency.campaign import campaign_findings
from balance_cli.diagnosis.consistency.findings import LOADED_TARE
from tests.support.rigs import rotor_balance
from tests.support.static_runs import loading, rigid_matrix, static_run

GEOMETRY = rotor_balance()
LOADS = loading()


def labeled(loads, tares):
    kinds = tuple("tare" if row in tares else "load" for row in range(len(loads)))
    return replace(static_run(GEOMETRY, rigid_matrix(GEOMETRY), loads), point_kinds=kinds)


def described(run):
    return describe_loaded_tares(run, arm=0.78)


def test_a_loaded_tare_is_named_with_its_load():
    text = described(labeled(LOADS, {0, 4}))
    assert text.startswith("load point 5 (Fx 640 N) is labeled as a tare")
    assert "load points 3 (Fx 320 N), 5 (Fx 640 N) are labeled as tares" in described(labeled(LOADS, {2, 4}))


def test_noise_hangers_and_the_load_of_a_trim_are_no_loaded_tares():
    lift = loading(components=("Fz",))
    noise = np.random.default_rng(1).normal(size=lift.shape) * [1.0, 1.0, 3.0, 0.5, 0.5, 0.5]
    assert described(labeled(lift + noise, {0})) == ""
    hanger = LOADS + np.array([0.0, 0.0, 100.0, 0.0, 0.0, 0.0])
    assert described(labeled(hanger, {0})) == ""
    about_trim = loading(trim_load=(0, 0, 2800.0, 0, 0, 150.0))
    assert described(labeled(about_trim, {0, len(about_trim) - 1})) == ""


@pytest.mark.parametrize("has_mechanics", [True, False])
def test_calibrations_and_checks_say_it(has_mechanics):
    geometry = GEOMETRY if has_mechanics else GEOMETRY.model_copy(update={"damping_ratio": None})
    (finding,) = campaign_findings(geometry, [labeled(LOADS, {0, 4})])
    assert (finding.kind, finding.runs) == (LOADED_TARE, ("s1",))
    assert campaign_findings(geometry, [labeled(LOADS, {0})]) == ()
