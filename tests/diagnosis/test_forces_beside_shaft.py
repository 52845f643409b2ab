"""Forces beside the shaft of a torque meter turn the plate where they act on it, and are taken to turn the shaft."""

from dataclasses import replace

import numpy as np

from balance_cli.campaign.recording.additions import LoadPoints, RunAdditions
from balance_cli.campaign.recording.point_loads import points_beside_shaft
from balance_cli.diagnosis.consistency.campaign import campaign_findings
from balance_cli.diagnosis.consistency.findings import REVERSED_CHANNEL, ConsistencyFinding


def run_with_points(campaign, position, direction):
    points = LoadPoints(("a", "b"), np.array(direction, float), np.array(position, float))
    return replace(campaign.runs_of_kind("sweep")[0], additions=RunAdditions(points))


def test_points_whose_force_turns_the_shaft(campaign):
    """`b` is in line with the shaft, forces along it do not turn it, and a drive on the plate turns the plate."""
    geometry = campaign.geometry
    x, y, z = geometry.hub
    position, direction = [(x, y + 0.2, z), (x, y, z - 0.3)], [(1, 0, 0), (2, 1, 0)]
    run = run_with_points(campaign, position, direction)
    assert points_beside_shaft(run, geometry) == ("a",)
    assert points_beside_shaft(run_with_points(campaign, position, [(0, 0, 1), (0, 0, 1)]), geometry) == ()
    carried = geometry.torque_meter.model_copy(update={"carried_by": "plate"})
    assert points_beside_shaft(run, geometry.model_copy(update={"torque_meter": carried})) == ()
    assert points_beside_shaft(campaign.runs_of_kind("sweep")[0], geometry) == ()


def test_a_contradiction_of_such_runs_names_the_shaft(campaign, monkeypatch):
    """A hammer on the plate had made sound channels `reversed, and read 0.18 times what the loads make`."""
    run = run_with_points(campaign, [(0, 0.4, 0), (0, 0, 0)], [(1, 0, 0), (0, 0, 1)])
    finding = ConsistencyFinding(REVERSED_CHANNEL, "fault", "y1.strain is reversed", (run.name,))
    monkeypatch.setattr("balance_cli.diagnosis.consistency.campaign.findings_from_rows", lambda *_: (finding,))
    made = campaign_findings(campaign.geometry, [run])[0]
    assert "unless a is on the plate" in made.sentence and made.kind == REVERSED_CHANNEL
    assert campaign_findings(campaign.geometry, [replace(run, additions=None)])[0] == finding
