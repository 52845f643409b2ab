"""Forces of cells from channels, measured and modeled, and the errors that the page quotes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from balance_cli.campaign.rig.channel import Channel
from balance_cli.model.balance import balance_model
from balance_cli.model.system_response import solve
from balance_cli.report.force_responses import (
    TORQUE_METER,
    error_band,
    measured_curve,
    model_response,
    relative_error,
    sensors,
)
from balance_cli.report.number_format import format_percent
from balance_cli.report.response_figures import phase_with_gaps
from balance_cli.report.responses import comparisons, section, sensor_errors
from balance_cli.report.sources import group_sources
from balance_cli.report.sweep_figures import cell_channel_pairs, cell_channel_ratio
from balance_cli.report.transfer import level_table
from balance_cli.signals.response.transfer import Transfer
from tests.support.other_rigs import other_rig
from tests.support.report_content import FREQUENCY, NOISE, artefact, campaign, measured, model, transfer
from tests.support.rigs import rotor_balance

RIG = rotor_balance()


def test_a_measured_curve_is_the_force_in_the_spring():
    """Against the springs' forces of the model, which know nothing of channels."""
    response = measured("Fx", 20.0)
    forces = solve(balance_model(RIG).system(), FREQUENCY).forces
    shown = sensors(RIG, [response], [])
    assert [sensor.name for sensor in shown] == [*RIG.cell_names, TORQUE_METER]
    for i, sensor in enumerate(shown):
        curve = measured_curve(response, sensor, "Fx", RIG)
        np.testing.assert_allclose(curve.value, forces[:, i, 0], rtol=1e-9, atol=1e-12)


def test_the_noise_of_a_curve_grows_where_the_channel_sees_less():
    response = measured("Fx", 20.0)
    strain = next(s for s in sensors(RIG, [response], []) if s.name == "x")
    assert list(strain.channels) == ["x.strain"]  # both channels are equally quiet: the first declared
    curve = measured_curve(response, strain, "Fx", RIG)
    np.testing.assert_allclose(curve.sigma, NOISE * np.sqrt(1 + (FREQUENCY / 90.0) ** 2), rtol=1e-9)


def test_the_run_of_the_highest_level_is_shown():
    assert [comparison.measured.run for comparison in comparisons(group_sources(campaign()))] == [
        "sweep-Fx-20",
        "sweep-Mz-20",
    ]


def test_a_response_that_grows_with_the_level_is_marked():
    low, high = measured("Fx", 5.0), measured("Fx", 20.0)
    grown = replace(high, response=1.01 * high.response)
    source = group_sources([(Path("tf.h5"), artefact("balance-transfer/1", transfer(), "b" * 64))]).transfers[0]
    for responses, difference, mark in (((low, high), 0.0, ""), ((low, grown), 0.01 / 1.01, "bad")):
        (row,) = level_table(source, responses).rows
        assert row[3].text == format_percent(difference)
        assert row[3].mark == mark


def test_the_true_model_is_off_by_nothing_and_a_scaled_one_by_its_scale():
    found = {source.label: source for source in group_sources(campaign()).models}
    comparison = comparisons(group_sources(campaign()))[0]
    noise, errors = sensor_errors(comparison)
    by_label = dict(zip([source.label for source, _ in comparison.models], errors, strict=True))
    assert by_label["rigid model (LS+ML)"] < 1e-9
    assert by_label["computed model"] > 0.1
    assert 0 < noise < 1e-3
    assert set(found) == set(by_label)
    value = np.array([1.0 + 1j, -2.0])
    assert relative_error(1.1 * value, value) == pytest.approx(0.1)


def test_a_model_of_another_rig_or_without_a_channel_is_compared_where_it_can_be():
    """Both ended in an internal error; nothing of another rig is compared, whatever its cells are called."""
    fewer = RIG.model_copy(update={"channels": tuple(c for c in RIG.channels if c.cell != "x")})
    elsewhere = RIG.model_copy(update={"rig": "another"})
    models = [(Path(f"{name}.h5"), artefact("balance-model/1", replace(model(), geometry=geometry), 64 * name))
              for name, geometry in (("1", fewer), ("2", elsewhere))]  # fmt: skip
    transfers = [(Path("tf.h5"), artefact("balance-transfer/1", transfer(), "b" * 64))]
    sources = group_sources([*transfers, *models])
    comparison = comparisons(sources)[0]
    responses = {source.file: predictions for source, predictions in comparison.models}
    assert set(responses["1.h5"].sensors) == {sensor.name for sensor in comparison.shown_sensors} - {"x"}
    assert responses["2.h5"].sensors == responses["2.h5"].channels == {}
    _, (without_x, another) = sensor_errors(comparison)
    assert without_x < 1e-9 and np.isnan(another)
    assert section(sources) is not None


def test_the_band_of_errors_is_that_of_the_excited_lines_where_modes_lie_beyond_the_usual_one():
    response = replace(measured("Fx", 20.0), frequency=np.linspace(30.0, 5000.0, 20))
    assert error_band([response], RIG) == (5.0, 150.0)
    assert error_band([response], other_rig("E")) == (30.0, 5000.0)  # modes of 300 to 700 Hz
    assert error_band([response], RIG.model_copy(update={"bodies": ()})) == (30.0, 5000.0)  # no modes are known


def test_channels_of_a_model_are_told_beside_its_forces():
    response = measured("Fx", 20.0)
    predicted = model_response(model(), FREQUENCY, 0.0, sensors(RIG, [response], []), RIG)
    np.testing.assert_allclose(predicted.channels["x.piezo"][:, 0], response.response[:, 7, 0], rtol=1e-9)


def test_two_channels_of_a_cell_differ_by_their_dynamics():
    responses = transfer().responses
    pairs = cell_channel_pairs({channel.name: channel.cell for channel in RIG.channels}, responses)
    assert pairs["z1"] == ("z1.piezo", "z1.strain")
    sensitivity = {channel.name: channel.sensitivity for channel in RIG.channels}
    frequency, ratio = cell_channel_ratio(pairs["z1"], responses, sensitivity)
    s = 2j * np.pi * frequency
    expected = 3.0 * s / (1 + 3.0 * s) * (1 + 1j * frequency / 90.0)
    np.testing.assert_allclose(frequency, FREQUENCY)
    np.testing.assert_allclose(ratio, expected, rtol=1e-9)


SUMS = ({"z1": 1.0, "z2": 1.0, "z3": 1.0}, {"z1": 1.0, "z2": -1.0}, {"z1": 0.5, "z3": 2.0})


def test_a_rig_without_a_channel_of_one_cell_shows_its_sums():
    channels = tuple(Channel(name=f"sum{i}", cells=parts, sensitivity=1e-3) for i, parts in enumerate(SUMS))
    rig = RIG.model_copy(update={"channels": channels})
    response = measured("Fz", 20.0, rig)
    shown = sensors(rig, [response], [])
    assert [sensor.name for sensor in shown] == ["sum0", "sum1", "sum2"]
    forces = solve(balance_model(rig).system(), FREQUENCY).forces
    for sensor, parts in zip(shown, SUMS, strict=True):
        expected = sum(weight * forces[:, rig.cell_names.index(cell), 2] for cell, weight in parts.items())
        curve = measured_curve(response, sensor, "Fz", rig)
        np.testing.assert_allclose(curve.value, expected, rtol=1e-9, atol=1e-12)
    source = artefact("balance-transfer/1", Transfer(geometry=rig, responses=(response,)), "b" * 64)
    made = section(group_sources([(Path("tf.h5"), source)]))
    assert "sum0 by sum0, sum1 by sum1, sum2 by sum2" in str(made)


def test_a_rig_of_accelerometers_shows_its_accelerations():
    place = {"position": (0.1, 0.0, 0.0), "axis": (0.0, 0.0, 1.0), "side": "metric"}
    channels = tuple(Channel(name=f"a{i}", accelerometer=place, sensitivity=0.01) for i in range(2))
    rig = RIG.model_copy(update={"channels": channels})
    assert [sensor.name for sensor in sensors(rig, [measured("Fz", 20.0, rig)], [])] == ["a0", "a1"]


def test_phase_is_not_drawn_across_the_picture():
    phase = phase_with_gaps(np.exp(1j * np.radians([170.0, 179.0, -175.0, -170.0])))
    np.testing.assert_allclose(phase, [170.0, 179.0, np.nan, -170.0])
