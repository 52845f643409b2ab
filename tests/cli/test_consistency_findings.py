"""What the cross-checks say reaches the artefacts, and through them the loads: JSON, warnings, flags."""

import json
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from click.testing import CliRunner

from balance_cli.api.artefacts import load_artefact
from balance_cli.campaign.recording.run import MemorySource
from balance_cli.campaign.recording.run_file import write_run
from balance_cli.campaign.rig.geometry_file import geometry_from_dict, geometry_to_dict, save_geometry
from balance_cli.cli import balance
from balance_cli.diagnosis.consistency.findings import (
    CHANNEL_FACTOR,
    DIFFERENT_RIG,
    FREQUENCIES,
    HUB_POSITION,
    NOISE_LEVEL,
    WARNING,
)
from balance_cli.diagnosis.consistency.severity import contradicts_loads
from balance_cli.io.units import STANDARD_GRAVITY
from balance_cli.simulation import CampaignPlan, Noise, RotorPlan, SweepPlan, simulate_campaign, true_rig
from balance_cli.simulation.preset_plans import HIGH_SWEEP_LEVELS
from tests.diagnosis.test_static_units import calibrated_only, in_units, statics
from tests.support.rigs import rotor_balance


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Sweeps of every component, a check run, wind runs, one of them in mV; the hub of the geometry is 0.1 m aside."""
    folder = tmp_path_factory.mktemp("hub-aside")
    sweeps = [
        SweepPlan(run=f"sweep-{name}", excited=(name,), level=(level,), period=2.0, periods=4)
        for name, level in HIGH_SWEEP_LEVELS.items()
    ]
    check = RotorPlan(run="check-1", rotor_speed=17.5, duration=6.0, harmonics={"Fx": (40.0, 20.0), "Fz": (60.0, 30.0)})
    winds = [RotorPlan(run=f"wind-{k}", rotor_speed=17.5, duration=4.0, kind="wind") for k in (1, 2)]
    plan = CampaignPlan(runs=(*sweeps, check, *winds))
    for run in simulate_campaign(true_rig(rotor_balance()), plan, Noise(), 3).runs:
        write_run(folder / f"{run.name}.h5", run)
    assert run.kind == "wind"
    millivolts = replace(run, name="wind-mV", source=MemorySource(1e3 * run.read().channels, None))
    write_run(folder / "wind-mV.h5", millivolts)
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


def test_the_noise_of_the_sweeps_that_a_response_keeps_is_compared_with_that_of_wind_runs(folder: Path) -> None:
    transfer, table = folder / "tf.h5", folder / "winds.csv"
    if not transfer.exists():
        call("sweep-tf", "-g", folder / "geometry.yaml", *sorted(folder.glob("sweep-*.h5")), "-o", transfer)
    winds = sorted(folder.glob("wind-*.h5"))
    said = call("reduce", "--transfer", transfer, *winds, "--harmonics", 2, "-o", table)
    (finding,) = said["consistency"]
    assert (finding["kind"], finding["runs"]) == (NOISE_LEVEL, ["wind-mV"]) and 900.0 < finding["factor"] < 1100.0
    assert finding["text"] in said["warnings"]
    contradicted = (
        pd.read_csv(table).groupby("run")["flag"].agg(lambda flags: flags.str.contains("model contradicted").all())
    )
    assert contradicted.to_dict() == {"wind-1": False, "wind-2": False, "wind-mV": True}


def test_only_what_changes_loads_flags_them() -> None:
    assert contradicts_loads(DIFFERENT_RIG, in_all_runs=False)
    assert contradicts_loads(NOISE_LEVEL, in_all_runs=True, factor=1e3)
    assert contradicts_loads(CHANNEL_FACTOR, in_all_runs=False, factor=1e-3)
    assert not contradicts_loads(CHANNEL_FACTOR, in_all_runs=False, factor=1.2)
    assert not contradicts_loads(CHANNEL_FACTOR, in_all_runs=True, factor=1e3)
    assert not contradicts_loads(FREQUENCIES, in_all_runs=True)


def test_static_loads_in_kgf_reach_text_json_and_artefact_of_a_rig_that_is_only_calibrated(tmp_path: Path) -> None:
    """One constant factor on all that follows: it had passed without a word, sensitivities counted as evidence."""
    runs = in_units(statics("A"), STANDARD_GRAVITY, STANDARD_GRAVITY)
    for run in runs:
        write_run(tmp_path / f"{run.name}.h5", run)
    files = [str(path) for path in sorted(tmp_path.glob("static-*.h5"))]
    save_geometry(tmp_path / "g.yaml", calibrated_only("A"))
    rig = ["-g", str(tmp_path / "g.yaml")]
    for words in (["check", *rig, *files], ["calibrate", *rig, *files, "-o", str(tmp_path / "c.h5")]):
        said = call(*words)
        (finding,) = said["consistency"]
        assert finding["severity"] == WARNING and finding["text"] in said["warnings"]
        assert "are they in kgf" in finding["text"]
        assert "are they in kgf" in CliRunner().invoke(balance, words).stderr
    assert load_artefact(tmp_path / "c.h5").consistency == (finding["text"],)
    assert said["scale_evidence"] == ["declared sensitivities"]
    matrix, again = tmp_path / "m.csv", tmp_path / "again.h5"
    call("calibrate", *rig, *files, "-o", tmp_path / "c.h5", "--matrix", matrix)
    said = call("calibrate", *rig, "--from-matrix", matrix, "-o", again)
    assert any("are they in kgf" in warning for warning in said["warnings"])
    assert load_artefact(again).consistency
