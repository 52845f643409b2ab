"""Temperature as an independent variable of the static calibration: apparent strain and drift of the sensitivity."""

import json
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from balance_cli.calibration.temperature import TemperatureRows, estimate_temperature_terms
from balance_cli.calibration.term_choice import choice_of_words
from balance_cli.calibration.terms import all_terms, linear_terms
from balance_cli.campaign.recording.additions import TEMPERATURE, MemoryAdditions, RunAdditions
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.cli import balance
from balance_cli.reduction.response_sources import static_source
from balance_cli.reduction.wind_off import zero_record
from balance_cli.report.temperature import temperature_blocks
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.point_temperature import point_loads_at_temperature
from balance_cli.steps.point_zeros import PointReadings
from balance_cli.steps.reduce import reduce_run
from balance_cli.steps.temperature_correction import refined_temperature_terms
from tests.support.nonlinear_rig import NAMES, other_flags, other_flags_of_rows, record
from tests.support.static_runs import AMPLITUDE, C0, RIG, loading

NOISE = 1e-4
SIGNAL = np.max(np.abs(C0 * AMPLITUDE), axis=1)
ZERO_SHIFT = 2e-3 * SIGNAL * np.array([1.0, -1.0, 0.5, 0.0, -0.7, 1.2, 0.0, 0.3])  # V/K
DRIFT = 8e-4 * C0 * np.array([1.0, -1.0, 0.0, 0.5, 1.0, -0.5, 0.0, 1.0])[:, None]  # of C0 per kelvin
REFERENCE = 21.0


def readings(loads, temperature):
    """Readings (m, 8) at loads (m, 6) and temperatures (m,)."""
    theta = np.asarray(temperature, float)[:, None] - REFERENCE
    return np.atleast_2d(loads) @ C0.T + theta * (ZERO_SHIFT + np.atleast_2d(loads) @ DRIFT.T)


def with_temperature(run, temperature):
    """The run with a temperature for each row."""
    source = MemoryAdditions({TEMPERATURE: np.asarray(temperature, float)[:, None]})
    return replace(run, additions=RunAdditions(temperature_names=("plate",), source=source))


def static_run(name, temperature, seed):
    """Ramps of all loads at temperatures (m,), or at one."""
    rng, loads = np.random.default_rng(seed), loading()
    values = np.broadcast_to(temperature, len(loads)) + 0.02 * rng.normal(size=len(loads))
    channels = 0.05 + readings(loads, values) + NOISE * rng.normal(size=(len(loads), len(NAMES)))
    run = Run(name, RIG.rig, "static", NAMES, len(loads), MemorySource(channels, loads), trim="bare")
    return with_temperature(run, values)


@cache
def warming_calibration():
    """A calibration during which the hall warms up and cools down by 8 K."""
    rows = len(loading())
    return calibrate([static_run("s", 21.0 + 4.0 * np.sin(np.arange(rows) / 9.0), 1)], RIG)


def wind(loads, temperature, kind="wind", seed=3):
    """A record at constant loads and temperature."""
    run = record(kind, np.zeros(6), kind=kind, curved=False, seed=seed)
    added = readings(loads, [temperature])[0]
    channels = run.read().channels + added
    return replace(run, source=MemorySource(channels, None), conditions={"temperature": temperature})


def reduced(cal, run, zero=None):
    return reduce_run(run, RIG, cal, static_source(cal), None if zero is None else zero_record(zero, NAMES))


def test_terms_and_their_errors_are_found():
    terms = warming_calibration().temperature
    sigma = np.sqrt(np.diagonal(terms.covariance, axis1=1, axis2=2)).T
    true = np.vstack([ZERO_SHIFT, DRIFT.T])
    order = [terms.channel_names.index(name) for name in NAMES]
    found = terms.coefficients[:, order]
    known = found != 0.0
    assert np.abs((found - true)[known] / sigma[:, order][known]).max() < 4.5
    assert np.all(known[0][ZERO_SHIFT != 0.0])
    assert terms.lowest < 17.5 and terms.highest > 24.5 and terms.names(0)[0] == "T"


def test_matrices_are_those_at_the_mean_temperature():
    cal = warming_calibration()
    trim = cal.trims["bare"]
    at_reference = C0 + (cal.temperature.reference - REFERENCE) * DRIFT
    assert np.abs((trim.C0 - at_reference) / trim.C0_sigma).max() < 5.0
    ignored = calibrate([replace(static_run("s", 21.0 + 4.0 * np.sin(np.arange(121) / 9.0), 1), additions=None)], RIG)
    assert ignored.temperature is None
    assert np.max(ignored.trims["bare"].residual / trim.residual) > 5.0


@pytest.mark.parametrize("temperature", [18.0, 24.0])
def test_mean_loads_at_another_temperature_are_right(temperature):
    cal, rng, z = warming_calibration(), np.random.default_rng(5), []
    for seed in range(12):
        loads = 0.7 * AMPLITUDE * rng.uniform(-1, 1, 6)
        found = reduced(cal, wind(loads, temperature, seed=seed), wind(np.zeros(6), 20.0, "zero", 100 + seed))
        assert other_flags(found.flags[0]) == ("",) * 6
        z.append((found.amplitude[0].real - loads) / found.sigma_cosine[0])
    assert np.mean(np.abs(z) < 1.96) > 0.88 and np.abs(z).max() < 4.5


def test_a_run_without_temperature_is_flagged_and_covered():
    cal, rng, z = warming_calibration(), np.random.default_rng(6), []
    for seed in range(12):
        loads = 0.7 * AMPLITUDE * rng.uniform(-1, 1, 6)
        run = replace(wind(loads, rng.uniform(17.0, 25.0), seed=seed), conditions={})
        found = reduced(cal, run, wind(np.zeros(6), 21.0, "zero", 100 + seed))
        assert other_flags(found.flags[0]) == ("no temperature",) * 6
        assert any("the run states none" in note for note in found.notes)
        z.append((found.amplitude[0].real - loads) / found.sigma_cosine[0])
    assert np.mean(np.abs(z) < 1.96) > 0.9


def test_a_temperature_outside_those_of_the_calibration_is_flagged():
    found = reduced(warming_calibration(), wind(0.5 * AMPLITUDE, 40.0), wind(np.zeros(6), 21.0, "zero"))
    assert all("extrapolated" in flag for flag in found.flags[0])
    assert any("40.0 degC is outside" in note for note in found.notes)


def test_runs_in_a_chamber_tell_the_zero_shift_by_their_zeros():
    runs = [
        static_run(f"s{number}", temperature, number) for number, temperature in enumerate((12.0, 18.0, 24.0, 30.0))
    ]
    terms = calibrate(runs, RIG).temperature
    shifting = ZERO_SHIFT != 0.0
    np.testing.assert_allclose(terms.coefficients[0][shifting], ZERO_SHIFT[shifting], rtol=0.05)
    np.testing.assert_allclose(terms.coefficients[3], DRIFT[:, 2], rtol=0.0, atol=0.05 * np.abs(DRIFT[:, 2]).max())


def test_a_constant_temperature_changes_nothing():
    run = static_run("s", 21.0, 1)
    assert calibrate([run], RIG).temperature is None


@pytest.mark.parametrize(
    ("own", "of_zero", "said"),
    [
        (23.0, 23.0, ""),
        (45.0, 45.0, "recorded at 45.0 degC, the calibration at 20.9 to 21.1 degC"),
        (24.0, 12.0, "recorded at 24.0 degC, its zero at 12.0 degC"),
        (45.0, 12.0, "21.1 and its zero at 12.0 degC"),
    ],
)
def test_loads_far_from_the_only_temperature_of_a_calibration_are_flagged(own, of_zero, said):
    """What temperature does there nobody has measured: 25 K at 0.05 % per kelvin are more than the accuracy."""
    cal = calibrate([static_run("s", 21.0, 1)], RIG)
    assert cal.stated_temperatures == pytest.approx((21.0, 21.0), abs=0.1)
    cal = replace(cal, stated_temperatures=(20.9, 21.1))
    found = reduced(cal, wind(0.5 * AMPLITUDE, own), wind(np.zeros(6), of_zero, "zero"))
    assert all(("extrapolated" in flag) == bool(said) for flag in found.flags[0])
    assert any(said in note for note in found.notes) or not said


def test_rows_far_from_the_only_temperature_of_a_calibration_are_flagged():
    cal = calibrate([static_run("s", 21.0, 1)], RIG)
    loads = 0.3 * AMPLITUDE * np.ones((3, 1))
    temperature = np.array([21.0, 25.0, 40.0])
    channels = readings(loads, temperature)
    rows = PointReadings("t", NAMES, channels, np.zeros(3, np.intp), np.zeros(3, bool), temperature=temperature)
    flags = point_loads_at_temperature(rows, cal).flags
    assert ["extrapolated temperature" in flag for flag in flags] == [False, False, True]


def test_no_term_is_found_where_there_is_none():
    found = 0
    for seed in range(3):
        rng, loads = np.random.default_rng([seed, 4]), loading()
        channels = loads @ C0.T + NOISE * rng.normal(size=(len(loads), len(NAMES)))
        run = Run("s", RIG.rig, "static", NAMES, len(loads), MemorySource(channels, loads), trim="bare")
        found += calibrate([with_temperature(run, np.linspace(15.0, 25.0, len(loads)))], RIG).temperature is not None
    assert found == 0


# ---- tables ----------------------------------------------------------------------------------------------------------


def test_loads_of_a_table_are_right_at_any_temperature_and_flagged_without_one():
    cal, rng = warming_calibration(), np.random.default_rng(9)
    loads = np.vstack([np.zeros(6), 0.7 * AMPLITUDE * rng.uniform(-1, 1, (60, 6))])
    temperature = rng.uniform(17.5, 24.5, len(loads))
    channels = readings(loads, temperature) + NOISE * rng.normal(size=(len(loads), len(NAMES)))
    rows = PointReadings("t", NAMES, channels, np.zeros(len(loads), np.intp), np.arange(len(loads)) == 0)
    known = point_loads_at_temperature(replace(rows, temperature=temperature), cal)
    unknown = point_loads_at_temperature(rows, cal)
    assert set(other_flags_of_rows(known.flags)) == {""}
    assert set(other_flags_of_rows(unknown.flags)) == {"no temperature"}
    for result in (known, unknown):
        assert np.mean((np.abs(result.loads - loads) < result.interval)[1:]) > 0.9
    assert np.all(np.median(unknown.sigma, axis=0) > 3.0 * np.median(known.sigma, axis=0))
    hot = point_loads_at_temperature(replace(rows, temperature=temperature + 30.0), cal)
    assert set(hot.flags[1:]) <= {"extrapolated temperature"} or "extrapolated temperature" in hot.flags[1]


@pytest.mark.parametrize(("unit", "scale", "offset"), [("degC", 1.0, 0.0), ("degF", 1.8, 32.0), ("K", 1.0, 273.15)])
def test_tables_state_temperatures_in_any_unit(tmp_path, unit, scale, offset):
    table = tmp_path / "points.csv"
    rng, m = np.random.default_rng(2), 40
    force, temperature = rng.uniform(-100.0, 100.0, m), rng.uniform(10.0, 30.0, m)
    reading = (
        1e-3 * force * (1.0 + 2e-3 * (temperature - 20.0)) + 1e-3 * (temperature - 20.0) + 1e-6 * rng.normal(size=m)
    )
    lines = [f"{f:.6f},{scale * t + offset:.4f},{r:.9f}" for f, t, r in zip(force, temperature, reading, strict=True)]
    table.write_text("\n".join([f"A [N],Temp [{unit}],B1 [V]", *lines]))
    (tmp_path / "g.yaml").write_text(
        "format: balance-geometry/1\nname: one\nrig: one\nchannels: [{name: B1}]\n"
        "components: [{name: A, direction: [-1, 0, 0]}]\n"
    )
    words = ["calibrate", "-g", str(tmp_path / "g.yaml"), str(table), "-o", str(tmp_path / "c.h5"), "--json", "-"]
    done = CliRunner().invoke(balance, words)
    assert done.exit_code == 0, done.output
    summary = json.loads(done.stdout)["temperature"]
    assert summary["channels"]["B1"]["T"]["value"] == pytest.approx(1e-3, rel=0.01)
    assert summary["channels"]["B1"]["A T"]["value"] == pytest.approx(2e-6, rel=0.01)
    words = ["apply", str(tmp_path / "c.h5"), str(table), "-o", str(tmp_path / "l.csv"), "--json", "-"]
    done = CliRunner().invoke(balance, words)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["runs"]["points"]["error"]["A"] < 0.02


def test_the_page_has_a_row_for_each_channel():
    """In % of its largest reading: the table is that of the estimates; without temperature there is none."""
    cal = warming_calibration()
    terms, trim = cal.temperature, next(iter(cal.trims.values()))
    heading, _, table = temperature_blocks(cal)
    assert heading.text == "Temperature" and len(table.rows) == len(trim.channel_names)
    channel = int(np.argmax(np.abs(terms.coefficients[0])))
    largest = np.max(np.abs(trim.C0[channel]) * trim.calibrated_range)
    assert float(table.rows[channel][1].text) == pytest.approx(100 * terms.coefficients[0, channel] / largest, rel=0.01)
    assert table.rows[channel][1].mark == "bad"
    assert not list(temperature_blocks(replace(cal, temperature=None)))


def test_products_that_were_not_selected_are_no_drift_of_the_sensitivities():
    """In ramps of several loads, each at its own temperature, drifts were off by up to 9 of their standard errors."""
    rng = np.random.default_rng(6)
    ramp = np.r_[0.0, 0.33, 0.67, 1.0, 0.5]
    axes = [*np.eye(6), *-np.eye(6), *rng.uniform(-1.0, 1.0, (30, 6))]
    x, series = np.vstack([np.outer(ramp, axis) for axis in axes]), np.repeat(np.arange(len(axes)), len(ramp))
    temperature = np.repeat(rng.uniform(15.0, 27.0, len(axes)), len(ramp)) + rng.normal(size=len(x))
    products = np.stack([x[:, i] * x[:, j] for i in range(6) for j in range(i, 6)], axis=1)
    channels = 0.05 + readings(x * AMPLITUDE, temperature) + NOISE * rng.normal(size=(len(x), len(NAMES)))
    channels += products @ (1e-3 * rng.normal(size=(21, len(NAMES)))) * SIGNAL
    run = Run("s", RIG.rig, "static", NAMES, len(x), MemorySource(channels, x * AMPLITUDE), trim="bare")
    selected = (*linear_terms(6), next(term for term in all_terms(6) if term.is_quadratic))
    model = SimpleNamespace(
        channel_names=NAMES,
        components=COMPONENTS,
        parsed_terms=selected,
        calibrated_range=AMPLITUDE,
        t=np.ones((7, len(NAMES))),
        is_nonlinear=True,
    )
    used = np.ones(len(x), bool)
    fitted = SimpleNamespace(model=model, used=used, run=0 * series, load_series=series, loads=x * AMPLITUDE)
    terms = refined_temperature_terms([with_temperature(run, temperature)], fitted)
    sigma = np.sqrt(np.diagonal(terms.covariance, axis1=1, axis2=2)).T[1:]
    # The sensitivities at the reference temperature of the terms drift by as much per kelvin as at any other.
    z = (terms.coefficients[1:] - DRIFT.T)[sigma > 0.0] / sigma[sigma > 0.0]
    assert len(z) > 30 and np.sqrt(np.mean(z**2)) < 1.3 and np.abs(z).max() < 4.0


def test_coefficients_of_products_contain_the_error_of_the_temperature_terms():
    """By noise alone their sigma was 1.2 times too small: a ramp of several loads has one temperature."""
    z = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        ramp = np.r_[0.0, 0.33, 0.67, 1.0, 0.5]
        axes = [*np.eye(6), *-np.eye(6), *rng.uniform(-1.0, 1.0, (15, 6))]
        x = np.vstack([np.outer(ramp, axis) for axis in axes])
        temperature = np.repeat(rng.uniform(15.0, 27.0, len(axes)), len(ramp)) + rng.normal(size=len(x))
        pairs = [(i, j) for i in range(6) for j in range(i, 6)]
        products = np.stack([x[:, i] * x[:, j] for i, j in pairs], axis=1)
        true = 2e-3 * rng.normal(size=(21, len(NAMES))) * SIGNAL
        channels = 0.05 + readings(x * AMPLITUDE, temperature) + NOISE * rng.normal(size=(len(x), len(NAMES)))
        run = Run("s", RIG.rig, "static", NAMES, len(x), MemorySource(channels + products @ true, x * AMPLITUDE))
        model = calibrate([with_temperature(run, temperature)], RIG, choice_of_words("quadratic", 0.01)).all_trims.model
        for place, term in enumerate(model.parsed_terms[6:], 6):
            pair = (term.i, term.i if term.single_load else term.j)
            scale = np.prod((model.calibrated_range / AMPLITUDE)[list(pair)])
            error = model.coefficients[place] - scale * true[pairs.index(pair)]
            z += (error / np.sqrt(model.covariance[:, place, place])).tolist()
    assert np.sqrt(np.mean(np.square(z))) < 1.1


@pytest.mark.parametrize(("noise", "allowed"), [(1e-7, False), (1e-4, True)])
def test_a_drift_that_no_row_shows_is_not_known_to_be_zero(noise, allowed):
    """The second channel warms by hours between its loads: its drift had no error, and loads were 5.4 sigma off."""
    rng, steps = np.random.default_rng(2), np.array([0.0, 50.0, 100.0, 50.0, 0.0])
    series = np.repeat(np.arange(12), 5)
    loads = np.tile(steps, 12)[:, None] * np.column_stack([series < 6, series >= 6])
    temperature = 20.0 + 0.3 * (series % 6) + 0.01 * rng.standard_normal(60)
    C, warming = np.array([[1e-3, 0.0], [0.0, 2e-3]]), (temperature - 20.0)[:, None]
    channels = loads @ C + 1e-5 * warming + np.array([1e-7, noise]) * rng.standard_normal((60, 2))
    channels[:, 0] += 2e-3 * warming[:, 0] * loads[:, 0] * 1e-3
    names = (("A", "B"), ("Fx", "Fy"))
    rows = TemperatureRows(*names, channels, loads, temperature, [loads, loads], series, np.ones(60))
    terms = estimate_temperature_terms(rows)
    sigma = float(np.sqrt(terms.covariance[1, 2, 2]))
    assert terms.coefficients[1, 0] != 0.0 and terms.coefficients[2, 1] == 0.0 and np.isnan(terms.t[2, 1])
    assert sigma == pytest.approx(2e-4 * 2e-3, rel=0.02) if allowed else 0.0 < sigma < 2e-8
