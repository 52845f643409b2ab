"""What the cross-checks say reaches the artefacts, and through them the loads: JSON, warnings, flags."""

import json
from pathlib import Path

import pandas as pd
import pytest
from click.testing import CliRunner

from balance_cli.api.artefacts import load_artefact
from balance_cli.campaign.recording.run_file import write_run
from balance_cli.campaign.rig.geometry_file import geometry_from_dict, geometry_to_dict, save_geometry
from balance_cli.cli import balance
from balance_cli.diagnosis.consistency.findings import CHANNEL_FACTOR, DIFFERENT_RIG, FREQUENCIES, HUB_POSITION
from balance_cli.diagnosis.consistency.severity import contradicts_loads
from balance_cli.simulation import CampaignPlan, Noise, RotorPlan, SweepPlan, simulate_campaign, true_rig
from balance_cli.simulation.preset_plans import HIGH_SWEEP_LEVELS
from tests.support.rigs import rotor_balance


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Sweeps of every component and a check run, with a geometry whose hub is 0.1 m aside."""
    folder = tmp_path_factory.mktemp("hub-aside")
    sweeps = [
        SweepPlan(run=f"sweep-{name}", excited=(name,), level=(level,), period=2.0, periods=4)
        for name, level in HIGH_SWEEP_LEVELS.items()
    ]
    check = RotorPlan(run="check-1", rotor_speed=17.5, duration=6.0, harmonics={"Fx": (40.0, 20.0), "Fz": (60.0, 30.0)})
    for run in simulate_campaign(true_rig(rotor_balance()), CampaignPlan(runs=(*sweeps, check)), Noise(), 3).runs:
        write_run(folder / f"{run.name}.h5", run)
    content = geometry_to_dict(rotor_balance())
    content["hub"] = [0.1, *content["hub"][1:]]
    save_geometry(folder / "geometry.yaml", geometry_from_dict(content))
    return folder


def call(*words: object) -> dict[str, object]:
    result = CliRunner().invoke(balance, [*map(str, words), "--json", "-"])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def test_a_warning_about_the_sweeps_reaches_the_loads(folder: Path) -> None:
    sweeps = sorted(folder.glob("sweep-*.h5"))
    transfer, loads, table = folder / "tf.h5", folder / "loads.h5", folder / "loads.csv"
    said = call("sweep-tf", "-g", folder / "geometry.yaml", *sweeps, "-o", transfer)
    (finding,) = said["consistency"]
    assert finding["kind"] == HUB_POSITION

    alone = call("reduce", "--transfer", transfer, folder / "check-1.h5", "--harmonics", 2, "-o", loads)
    assert any(finding["text"] in warning for warning in alone["warnings"])
    assert any(finding["text"] in warning for warning in load_artefact(loads).warnings)

    together = call("reduce", "--transfer", transfer, *sweeps, folder / "check-1.h5", "--harmonics", 2, "-o", table)
    flags = pd.read_csv(table)["flag"]
    assert flags.str.contains("model contradicted").all()
    assert together["runs"]["check-1"]["flags"]["model contradicted"] == len(flags)

    result = CliRunner().invoke(
        balance,
        [
            *("reduce", "--transfer", str(transfer), str(folder / "check-1.h5"), "--harmonics", "20"),
            *("-o", str(folder / "beyond.csv")),
        ],
    )
    assert result.exit_code == 2
    assert f"{folder / 'check-1.h5'}: the response to Fx was measured from" in result.output


def test_only_what_changes_loads_flags_them() -> None:
    assert contradicts_loads(DIFFERENT_RIG, in_all_runs=False)
    assert contradicts_loads(CHANNEL_FACTOR, in_all_runs=False, factor=1e-3)
    assert not contradicts_loads(CHANNEL_FACTOR, in_all_runs=False, factor=1.2)
    assert not contradicts_loads(CHANNEL_FACTOR, in_all_runs=True, factor=1e3)
    assert not contradicts_loads(FREQUENCIES, in_all_runs=True)
