import json
from dataclasses import replace

import numpy as np
import pytest

from balance_cli.calibration.result import Calibration
from balance_cli.calibration.static_matrices import inverse_matrix
from balance_cli.campaign.recording.run import MemorySource
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.io.errors import UserError
from balance_cli.steps.calibrate import calibrate
from tests.support.rigs import CONFIGS, one_degree_of_freedom, two_degrees_of_freedom
from tests.support.static_runs import AMPLITUDE, C0, RIG, loading, rigid_matrix, static_run, without


def test_exact_matrices_of_the_rigid_rig():
    trim = calibrate([static_run(RIG, C0, loading(), offset=0.3)], RIG).trims["bare"]
    np.testing.assert_allclose(trim.C0, C0, atol=1e-12)
    np.testing.assert_allclose(trim.T0 @ C0, np.eye(6), atol=1e-7)
    np.testing.assert_allclose(trim.offsets, 0.3, atol=1e-9)
    assert max(trim.residual_percent_fs.values()) < 1e-6
    applied = np.array([100.0, -50.0, 900.0, 20.0, -30.0, 40.0])
    np.testing.assert_allclose(trim.loads(C0 @ applied + 0.3), applied, atol=1e-7)
    np.testing.assert_allclose(trim.loads(C0 @ applied + 0.5, zero_shift=0.2), applied, atol=1e-7)


def repeated_trims(count, geometry, truth, loads, rng):
    """Trim calibrations of so many repetitions of the same loads, each a trim of its own; together they are cheaper."""
    runs = [static_run(geometry, truth, loads, rng, name=f"s{i}", trim=f"trim {i}") for i in range(count)]
    return calibrate(runs, geometry).trims.values()


def test_coverage_of_the_standard_errors_where_rows_are_unequally_noisy():
    rng = np.random.default_rng(1)
    C0_inside, T0_inside, fit = [], [], []
    for trim in repeated_trims(60, RIG, C0, loading(), rng):
        C0_inside.append(np.abs(trim.C0 - C0) < 1.96 * trim.C0_sigma)
        # Only T0 C0 is told by the loads; where there is redundancy T0 moves with the weights besides.
        error = trim.T0 @ C0 - np.eye(6)
        sigma = np.sqrt(np.einsum("ai,ijlj,al->aj", trim.T0, trim.C0_covariance, trim.T0))
        T0_inside.append(np.abs(error) < 1.96 * sigma)
        fit.append(trim.lack_of_fit)
    assert 0.93 < np.mean(C0_inside) < 0.975
    assert 0.93 < np.mean(T0_inside) < 0.975
    assert np.mean(fit) == pytest.approx(1.0, abs=0.15)


def test_six_channels_give_the_inverse_and_its_standard_errors():
    geometry = two_degrees_of_freedom()
    truth = rigid_matrix(geometry)
    exact = np.linalg.inv(truth[:, [2, 4]])
    rng = np.random.default_rng(2)
    loads = loading(components=("Fz", "My"))
    inside = []
    for trim in (trim for _ in range(3) for trim in repeated_trims(50, geometry, truth, loads, rng)):
        assert trim.components == ("Fz", "My")
        inside.append(np.abs(trim.T0 - exact) < 1.96 * trim.T0_sigma)
    assert 0.92 < np.mean(inside) < 0.98


def test_derivative_of_the_weighted_pseudo_inverse():
    rng = np.random.default_rng(3)
    C, S = rng.normal(size=(8, 6)), np.cov(rng.normal(size=(8, 40)))
    T0, derivative = inverse_matrix(C, S)
    np.testing.assert_allclose(T0 @ C, np.eye(6), atol=1e-10)
    h = 1e-6
    for i, j in [(0, 0), (3, 5), (7, 2)]:
        step = np.zeros_like(C)
        step[i, j] = h
        numerical = (inverse_matrix(C + step, S)[0] - inverse_matrix(C - step, S)[0]) / (2 * h)
        np.testing.assert_allclose(derivative[:, :, i, j], numerical, rtol=1e-5, atol=1e-7)


def test_weighted_inverse_turns_to_the_quieter_channels():
    rng = np.random.default_rng(4)
    run = static_run(RIG, C0, loading(), rng)
    block = run.read()
    noisy = block.channels.copy()
    noisy[:, 3] += 0.02 * rng.normal(size=len(noisy))
    trim = calibrate([replace(run, source=MemorySource(noisy, block.loads))], RIG).trims["bare"]
    sound = calibrate([without(run, "z1.strain")], RIG).trims["bare"]
    plain = np.linalg.pinv(C0)
    noise = np.diag(np.where(np.arange(8) == 3, 0.02, 2e-4) ** 2)
    weighted, unweighted = (np.diagonal(T @ noise @ T.T) for T in (trim.T0, plain))
    without_it = np.diagonal(sound.T0 @ np.delete(np.delete(noise, 3, 0), 3, 1) @ sound.T0.T)
    assert np.all(weighted < 1.3 * without_it)
    assert unweighted[2] > 100 * weighted[2]


def test_runs_of_one_trim_are_pooled_each_with_its_own_offset():
    rng = np.random.default_rng(5)
    one = static_run(RIG, C0, loading(components=("Fx", "Fy", "Fz")), rng, "s1", offset=0.1)
    two = static_run(RIG, C0, loading(components=("Mx", "My", "Mz")), rng, "s2", offset=-0.4)
    other = static_run(RIG, C0, loading((0, 0, 2500, 0, 0, 250), scale=0.3), rng, "s3", "hover")
    found = calibrate([one, two, other], RIG)
    assert list(found.trims) == ["bare", "hover"]
    assert found.trims["bare"].runs == ("s1", "s2")
    np.testing.assert_allclose(found.trims["bare"].offsets, np.repeat([[0.1], [-0.4]], 8, axis=1), atol=5e-4)
    np.testing.assert_allclose(found.trims["bare"].C0, C0, atol=2e-6)
    np.testing.assert_allclose(found.trims["hover"].mean_load, [0, 0, 2500, 0, 0, 250], atol=0.1)
    assert found.nearest_trim({"Fz": 2000.0, "Mz": 200.0}).trim == "hover"
    assert found.nearest_trim({"Fz": 200.0}).trim == "bare"
    # Full range is the largest load of the whole calibration, in every trim.
    np.testing.assert_allclose(
        found.trims["hover"].calibrated_range, np.maximum(AMPLITUDE, [0, 0, 3550, 0, 0, 385]), rtol=1e-3
    )


def test_residuals_in_percent_of_full_range():
    rng = np.random.default_rng(6)
    trim = calibrate([static_run(RIG, C0, loading(), rng, noise=1e-3, load_noise=0.0)], RIG).trims["bare"]
    # White noise of 1 mV through T0, of the weighted inverse: sqrt(diag (C0' C0)^-1) mV.
    expected = 1e-3 * np.sqrt(np.diagonal(np.linalg.inv(C0.T @ C0))) / AMPLITUDE * 100
    np.testing.assert_allclose(list(trim.residual_percent_fs.values()), expected, rtol=0.25)
    assert trim.channel_residual_percent_fs["z1.strain"] == pytest.approx(100 * 1e-3 / (0.002 * 5000), rel=0.25)
    assert trim.channel_residual_percent_fs["torque"] == pytest.approx(100 * 1e-3 / (0.02 * 450), rel=0.25)


def with_friction(loads, j, half_width):
    """Loads as the cells feel them where a contact holds back `half_width` against the last movement."""
    felt = loads.copy()
    felt[:, j] -= half_width * np.sign(np.diff(loads[:, j], prepend=0.0))
    return felt


def test_hysteresis_up_less_down():
    rng = np.random.default_rng(7)
    loads = loading()
    run = static_run(RIG, C0, loads, rng)
    friction = (with_friction(loads, 2, 1.5) - loads) @ C0.T
    block = run.read()
    trim = calibrate([replace(run, source=MemorySource(block.channels + friction, block.loads))], RIG).trims["bare"]
    loop = trim.hysteresis
    np.testing.assert_allclose(loop.loads[2], -3.0, atol=4 * loop.loads_sigma[2])
    assert loop.loads_sigma[2] < 0.1
    np.testing.assert_allclose(loop.channels[:, 2], -3.0 * C0[:, 2], atol=5e-4)
    others = [0, 1, 3, 4, 5]
    assert np.all(np.abs(loop.loads[others]) < 4 * loop.loads_sigma[others])


def test_hysteresis_is_unknown_where_the_load_only_rose():
    rng = np.random.default_rng(8)
    rising = [np.linspace(0, AMPLITUDE[j], 8)[:, None] * np.eye(6)[j] for j in range(6)]
    trim = calibrate([static_run(RIG, C0, np.vstack(rising), rng)], RIG).trims["bare"]
    assert np.all(np.isnan(trim.hysteresis.loads)) and np.all(np.isnan(trim.hysteresis.channels))
    np.testing.assert_allclose(trim.C0, C0, atol=5e-6)


def test_one_degree_of_freedom_needs_its_own_component_alone():
    geometry = one_degree_of_freedom()
    loads = loading(components=("Fz",))
    trim = calibrate([static_run(geometry, np.eye(6)[2:3] * 0.002, loads)], geometry).trims["bare"]
    assert trim.components == ("Fz",)
    np.testing.assert_allclose(trim.C0, [[0.002]], rtol=1e-9)
    np.testing.assert_allclose(trim.loads([[1.0]]), [[0, 0, 500, 0, 0, 0]], atol=1e-6)


def test_a_lost_channel_is_left_out_while_the_rest_determine_the_loads():
    run = static_run(RIG, C0, loading(), np.random.default_rng(9))
    trim = calibrate([without(run, "z3.strain")], RIG).trims["bare"]
    assert "z3.strain" not in trim.channel_names and trim.excluded_channels == {"z3.strain": "absent from the run"}
    np.testing.assert_allclose(trim.T0 @ np.delete(C0, 5, axis=0), np.eye(6), atol=2e-3)


@pytest.mark.parametrize(
    ("lost", "fault"),
    [
        (("z3.strain", "x.strain"), "cannot distinguish `Fx` and `My`"),
        (("torque",), "`Mz` was hardly loaded, or no usable channel shows it.*torque: absent"),
        (("z3.strain", "z2.strain", "y1.strain"), "5 usable channels cannot determine 6 load components"),
    ],
)
def test_too_many_lost_channels_are_refused(lost, fault):
    run = static_run(RIG, C0, loading(), np.random.default_rng(10))
    with pytest.raises(UserError, match=fault):
        calibrate([without(run, *lost)], RIG)


@pytest.mark.parametrize("constant", [0.0, 700.0])
def test_a_component_that_was_never_loaded_is_named(constant):
    loads = loading((0, 0, 0, 0, constant, 0), components=("Fx", "Fy", "Fz", "Mx", "Mz"))
    with pytest.raises(UserError, match=r"trim bare.*`My` was never loaded"):
        calibrate([static_run(RIG, C0, loads, np.random.default_rng(11))], RIG)


def test_components_that_were_only_loaded_together_are_named():
    loads = loading(components=("Fx", "Fy", "Fz", "Mx", "Mz"))
    loads[:, 4] = 0.5 * loads[:, 0]
    with pytest.raises(UserError, match=r"`Fx` and `My` were never loaded separately"):
        calibrate([static_run(RIG, C0, loads)], RIG)


def test_too_few_rows_and_no_static_run_are_refused():
    with pytest.raises(UserError, match="no static run"):
        calibrate([replace(static_run(RIG, C0, loading()), kind="sweep")], RIG)
    with pytest.raises(UserError, match="load points"):
        calibrate([static_run(RIG, C0, np.diag(AMPLITUDE))], RIG)


def test_command_writes_the_calibration_and_its_summary(tmp_path):
    from click.testing import CliRunner

    from balance_cli.campaign.recording.run_file import write_run
    from balance_cli.cli import balance
    from balance_cli.io.artefacts import load_artefact

    rng = np.random.default_rng(12)
    write_run(tmp_path / "s1.h5", static_run(RIG, C0, loading(), rng))
    sweep = replace(
        static_run(RIG, C0, loading(), rng, "f1"),
        kind="sweep",
        trim=None,
        sample_rate=100.0,
        excited=("Fx",),
        excitation="random",
        level=(10.0,),
    )
    write_run(tmp_path / "f1.h5", sweep)
    words = ["calibrate", "-g", str(CONFIGS / "rts-6.yaml"), str(tmp_path / "s1.h5"), str(tmp_path / "f1.h5")]
    out, summary = tmp_path / "c.h5", tmp_path / "c.json"
    done = CliRunner().invoke(balance, [*words, "-o", str(out), "--json", str(summary)])
    assert done.exit_code == 0, done.output
    found = json.loads(summary.read_text())
    assert set(found["left_out"]) == {"f1"}
    trim = found["trims"]["bare"]
    assert set(trim["residual_percent_fs"]) == set(COMPONENTS) and trim["condition"] > 1
    assert trim["C0"]["x.strain"]["Fx"]["value"] == pytest.approx(0.002, rel=1e-3)
    stored = load_artefact(out, {"balance-calibration/1": Calibration}).content
    np.testing.assert_array_equal(stored.trims["bare"].T0, calibrate_again(tmp_path / "s1.h5").T0)

    alone = CliRunner().invoke(balance, [*words[:3], str(tmp_path / "f1.h5"), "-o", str(tmp_path / "no.h5")])
    assert alone.exit_code == 2 and not (tmp_path / "no.h5").exists()
    assert "no static run" in alone.output


def calibrate_again(path):
    from balance_cli.campaign.recording.run_file import open_run

    return calibrate([open_run(path)], RIG).trims["bare"]
