"""The paper's form: recovery of the truth, the sensors, the figures of docs/theory/paper-notes.md, errors."""

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import eigh

from balance_cli.campaign.recording.run_file import open_run
from balance_cli.estimation.paper.equations import declared_coefficients
from balance_cli.estimation.paper.fit import identify_paper_form, response
from balance_cli.estimation.paper.result import PaperOptions
from balance_cli.estimation.paper.sensors import sensor_rule
from balance_cli.io.errors import UserError
from balance_cli.signals.periodic import periodic_spectrum
from tests.support.paper_truth import make_plate, sweep, sweeps
from tests.support.rigs import one_degree_of_freedom, rotor_balance, two_degrees_of_freedom

FIVE = ("Fx", "Fy", "Fz", "Mx", "My")
EVERYWHERE = (5.0, 150.0)
LINES = np.arange(5.0, 150.01, 0.5)
SAMPLE = Path(__file__).parents[2] / "sample_data"


def relative(result, true):
    return np.linalg.norm(result - true) / np.linalg.norm(true)


def assert_recovered(fit, truth, tolerance=1e-6):
    D, K, B_F = truth.coefficients(fit.rule.matrix, fit.inputs)
    assert relative(fit.model.D, D) < tolerance
    assert relative(fit.model.K, K) < tolerance
    assert relative(fit.model.B_F, B_F) < tolerance


@pytest.fixture(scope="module")
def balance():
    return make_plate(rotor_balance())


@pytest.fixture(scope="module")
def noise_free(balance):
    return sweeps(balance, FIVE, LINES)


@pytest.mark.parametrize("method", ["ls", "ml", "ls+ml"])
def test_true_matrices_come_back_from_data_without_noise(balance, noise_free, method):
    fit = identify_paper_form(balance.geometry, noise_free, PaperOptions(method, "full", EVERYWHERE))
    assert_recovered(fit, balance)
    assert fit.converged and fit.stable
    assert fit.misfit.frf_error < 1e-6
    np.testing.assert_allclose([m.frequency_hz for m in fit.modes], balance.omega / (2 * np.pi), rtol=1e-8)
    np.testing.assert_allclose([m.damping_ratio for m in fit.modes], 0.01, rtol=1e-5)


def test_two_loads_at_once_and_strain_where_a_piezo_is_missing(balance):
    geometry = balance.geometry
    channels = tuple(name for name in geometry.channel_names if name not in ("torque", "z2.piezo", "y1.strain"))
    together = sweep(balance, {"Fx": 3.0, "My": 2.0}, LINES, channels)
    second = sweep(balance, {"Fx": 1.0, "My": -2.0, "Mz": 5.0}, LINES, channels, seed=1)
    alone = sweeps(balance, ("Fy", "Fz", "Mx"), LINES, channels=channels)
    alone[0].channels[:, channels.index("x.piezo")] = np.nan
    fit = identify_paper_form(geometry, [together, second, *alone], PaperOptions("ls", "full", EVERYWHERE))
    assert fit.inputs == FIVE
    assert_recovered(fit, balance)


@pytest.mark.parametrize("method", ["ls", "ml"])
def test_as_many_cells_as_freedoms(method):
    truth = make_plate(two_degrees_of_freedom())
    runs = sweeps(truth, ("Fz", "My"), np.arange(10.0, 125.0, 0.5))
    fit = identify_paper_form(truth.geometry, runs, PaperOptions(method, "full"))
    assert fit.rule.merged == () and fit.rule.names == ("a", "b")
    assert_recovered(fit, truth)


def test_one_mass_on_one_cell():
    truth = make_plate(one_degree_of_freedom())
    fit = identify_paper_form(truth.geometry, sweeps(truth, ("Fz",), LINES), PaperOptions(band=EVERYWHERE))
    # s = c z: s'' + 2 zeta omega s' + omega^2 s = (c/m) F
    np.testing.assert_allclose(fit.model.K, [[4e5 / 10.0]], rtol=1e-9)
    np.testing.assert_allclose(fit.model.D, [[2 * 0.02 * np.sqrt(4e4)]], rtol=1e-7)
    np.testing.assert_allclose(fit.model.B_F, [[4e4]], rtol=1e-9)


def test_load_points_at_rest_are_the_response_at_zero(balance, noise_free):
    fit = identify_paper_form(balance.geometry, noise_free, PaperOptions("ls", "full", EVERYWHERE))
    flexibility = np.linalg.inv(balance.K)
    static = fit.rule.matrix @ (balance.c[:, None] * balance.B) @ flexibility @ balance.F[:, :5]
    np.testing.assert_allclose(response(fit, np.array([0.0]))[0], static, rtol=1e-6, atol=1e-9)


def test_sensors_of_the_campaign(balance):
    rule = sensor_rule(balance.geometry)
    assert rule.names == ("x", "y1", "y2", "z1", "z2", "z34")
    assert rule.merged == ("z3", "z4")
    # The resultant of z3 and z4 is that of one cell at their stiffness-weighted mean position.
    z3, z4 = balance.geometry.cells[5:]
    p = (5.2e6 * np.array(z3.position) + 4.9e6 * np.array(z4.position)) / 10.1e6
    merged = z3.model_copy(update={"position": tuple(p), "stiffness": 10.1e6})
    resultant = make_plate(balance.geometry.model_copy(update={"cells": (*balance.geometry.cells[:5], merged)}))
    np.testing.assert_allclose(
        (rule.matrix @ (balance.c[:, None] * balance.B))[5], resultant.c[5] * resultant.B[5], rtol=1e-12
    )


def test_stiffness_from_six_sensors_would_be_wrong(balance):
    """Note 6: s_z34 is exact, K formed from six sensors is not; 25.3 Hz becomes 23.0."""
    rule = sensor_rule(balance.geometry)
    P = rule.matrix @ (balance.c[:, None] * balance.B)
    six = P.T @ (P / (rule.matrix @ balance.c)[:, None])
    right, wrong = (np.sqrt(eigh(K, balance.M, eigvals_only=True)) / (2 * np.pi) for K in (balance.K, six))
    assert right[1] == pytest.approx(25.3, abs=0.05)
    assert wrong[0] == pytest.approx(23.0, abs=0.05)
    # The other modes of the pair stay where they are: it is the second mode that falls below the first.
    assert wrong[1] == pytest.approx(right[0], abs=0.05)
    declared = declared_coefficients(balance.geometry, rule, FIVE)
    eigenvalues = np.sqrt(np.sort(np.linalg.eigvals(declared.K).real)) / (2 * np.pi)
    np.testing.assert_allclose(eigenvalues, right, rtol=1e-10)


def test_start_from_geometry_is_the_plate(balance):
    rule = sensor_rule(balance.geometry)
    declared = declared_coefficients(balance.geometry, rule, FIVE)
    for result, true in zip(
        (declared.D, declared.K, declared.B_F), balance.coefficients(rule.matrix, FIVE), strict=True
    ):
        assert relative(result, true) < 1e-12


def test_diagonal_damping_alone_leaves_five_percent(balance):
    """Note 11: 4.8 % rms for a noise-free rigid plate with 1 % modal damping; a full matrix leaves nothing."""
    runs = sweeps(balance, FIVE, np.arange(5.0, 150.01, 0.25))
    errors = {}
    for damping in ("diagonal", "full"):
        options = PaperOptions("ls+ml", damping, EVERYWHERE, noise="equal")
        errors[damping] = list(identify_paper_form(balance.geometry, runs, options).misfit.frf_errors.values())
    assert np.mean(errors["diagonal"]) == pytest.approx(0.048, abs=0.001)
    assert np.max(errors["full"]) < 1e-6


def test_opposite_axes_are_merged_with_a_minus_sign(balance):
    cells = [*balance.geometry.cells[:6], balance.geometry.cells[6].model_copy(update={"axis": (0.0, 0.0, -2.0)})]
    turned = make_plate(balance.geometry.model_copy(update={"cells": tuple(cells)}))
    rule = sensor_rule(turned.geometry)
    assert rule.merged == ("z3", "z4")
    np.testing.assert_array_equal(rule.matrix[5], [0, 0, 0, 0, 0, 1, -1])
    fit = identify_paper_form(turned.geometry, sweeps(turned, FIVE, LINES), PaperOptions("ls", "full", EVERYWHERE))
    assert_recovered(fit, turned)


def test_a_pair_that_leaves_the_plate_loose_is_passed_over(balance):
    """The last parallel pair in declared order is y1, y2 here; together they no longer see the yaw."""
    x, y1, y2, *z = balance.geometry.cells
    rule = sensor_rule(balance.geometry.model_copy(update={"cells": (x, *z, y1, y2)}))
    assert rule.merged == ("z3", "z4")
    assert rule.names == ("x", "z1", "z2", "z34", "y1", "y2")


def without(geometry, *cells):
    remaining = tuple(cell for cell in geometry.cells if cell.name not in cells)
    return geometry.model_copy(update={"cells": remaining})


@pytest.mark.parametrize(
    ("cells", "message"),
    [(("z3", "z4"), "5 cells for 6 freedoms"), (("x",), "do not determine the motion")],
)
def test_rigs_that_the_form_does_not_fit(balance, cells, message):
    with pytest.raises(UserError, match=message) as caught:
        sensor_rule(without(balance.geometry, *cells))
    assert "--form physical" in str(caught.value)


def test_one_cell_too_many_without_a_parallel_pair():
    geometry = two_degrees_of_freedom()
    tilted = geometry.cells[0].model_copy(update={"name": "c", "axis": (0.3, 0.0, 1.0)})
    cells = (geometry.cells[0], geometry.cells[1].model_copy(update={"axis": (-0.3, 0.0, 1.0)}), tilted)
    with pytest.raises(UserError, match="no two cells have parallel axes"):
        sensor_rule(geometry.model_copy(update={"cells": cells}))


def test_runs_that_cannot_determine_the_equations(balance, noise_free):
    geometry = balance.geometry
    cases = {
        "no run excites the plate": (sweeps(balance, ("Mz",), LINES), PaperOptions()),
        "no line from 200 to 300 Hz": (noise_free, PaperOptions(band=(200.0, 300.0))),
        "too few": (sweeps(balance, ("Fx",), LINES[:6]), PaperOptions(band=EVERYWHERE)),
        "no usable channel of cell y2": (sweeps(balance, FIVE, LINES, channels=("x.piezo", "y1.piezo")), None),
    }
    for message, (runs, options) in cases.items():
        with pytest.raises(UserError, match=message):
            identify_paper_form(geometry, runs, options)


def test_a_rig_whose_cells_are_read_in_sums_has_no_such_form(balance, noise_free):
    channels = tuple(
        channel.model_copy(update={"cell": None, "cells": {"x": 1.0, "y1": 1.0}}) if channel.cell == "x" else channel
        for channel in balance.geometry.channels
    )
    with pytest.raises(UserError, match=r"no channel reads cell x alone.*Use `physical`"):
        identify_paper_form(balance.geometry.model_copy(update={"channels": channels}), noise_free, PaperOptions())


def test_freedoms_that_nothing_excites():
    """On the symmetric bar Fz at the centre heaves only: the pitch equation is not determined."""
    truth = make_plate(two_degrees_of_freedom())
    with pytest.raises(UserError, match="do not excite every freedom"):
        identify_paper_form(truth.geometry, sweeps(truth, ("Fz",), LINES), PaperOptions("ls", "full"))


@pytest.fixture(scope="module")
def sample():
    runs = (open_run(SAMPLE / f"sweep-{component}-low.h5") for component in FIVE)
    return [periodic_spectrum(run, run.channel_names) for run in runs]


def test_sample_campaign_two_computed_modes_lie_above_the_identified(sample):
    """The paper's own result, on the sample campaign: the two highest modes come out far below the computed ones."""
    geometry = rotor_balance()
    fit = identify_paper_form(geometry, sample, PaperOptions(damping="full"))
    computed = make_plate(geometry).omega / (2 * np.pi)
    identified = np.array([mode.frequency_hz for mode in fit.modes])
    assert fit.converged and fit.noise == "full"
    np.testing.assert_allclose(identified[:3], computed[:3], rtol=0.07)
    assert np.all(computed[4:] > 1.05 * identified[4:])
    assert 0.01 < fit.misfit.frf_error < 0.08
    # Not a rigid plate: far outside the measured noise.
    assert fit.misfit.chi2_per_dof > 100.0


def test_sample_campaign_with_diagonal_damping_falls_back_on_a_diagonal_noise_covariance(sample):
    """With the full S the cost has no minimum that could be found; the fit says which S it ended with."""
    first = identify_paper_form(rotor_balance(), sample, PaperOptions("ls"))
    assert not first.stable and first.misfit.frf_error > 0.3
    fit = identify_paper_form(rotor_balance(), sample, PaperOptions(max_iterations=30))
    assert fit.options.noise == "full" and fit.noise == "diagonal"
    assert fit.converged and fit.stable and len(fit.modes) == 6
    assert fit.misfit.frf_error < 0.12
    np.testing.assert_array_equal(fit.S, np.diag(np.diag(fit.S)))


def test_names_and_units_of_the_parameters(noise_free):
    fit = identify_paper_form(rotor_balance(), noise_free, PaperOptions("ls"))
    table = dict(zip(fit.parameter_names, zip(fit.parameters, fit.parameter_units, strict=True), strict=True))
    assert len(table) == 6 + 36 + 30
    assert table["D[z34,z34]"] == (fit.model.D[5, 5], "1/s")
    assert table["K[x,y1]"] == (fit.model.K[0, 1], "1/s2")
    assert table["B_F[y1,Fz]"] == (fit.model.B_F[1, 2], "1/s2")
    assert table["B_F[z1,My]"] == (fit.model.B_F[3, 4], "1/(m s2)")
