"""Units against the published factors of NIST SP 811, appendix B, and their spellings."""

import math

import pytest

from balance_cli.io.column_heads import split_unit
from balance_cli.io.errors import UserError
from balance_cli.io.units import (
    ACCELERATION,
    CHARGE,
    FORCE,
    FREQUENCY,
    MASS,
    MOMENT,
    NUMBER,
    RATIO,
    TEMPERATURE,
    VOLTAGE,
    Unit,
    _all_units,
    can_be_unit_of,
    parse_unit,
    short_reading,
)

PUBLISHED = {
    "lbf": ("N", 4.448222),
    "kgf": ("N", 9.80665),
    "kip": ("N", 4.448222e3),
    "ozf": ("N", 2.780139e-1),
    "in-lbf": ("N m", 1.129848e-1),
    "ft-lbf": ("N m", 1.355818),
    "ozf in": ("N m", 7.061552e-3),
    "kgf m": ("N m", 9.80665),
    "in": ("m", 2.54e-2),
    "ft": ("m", 3.048e-1),
    "deg": ("rad", 1.745329e-2),
    "rpm": ("Hz", 1.666667e-2),
    "mV": ("V", 1e-3),
    "uV/V": ("V/V", 1e-6),
}


@pytest.mark.parametrize("text", PUBLISHED)
def test_factors_are_those_of_nist(text: str) -> None:
    unit = parse_unit(text)
    dimension, factor = PUBLISHED[text]
    assert unit.dimension == dimension
    assert unit.factor == pytest.approx(factor, rel=5e-7)


@pytest.mark.parametrize("text", ["N m", "N.m", "Nm", "N·m", "N-m", "N*m", " N  m ", "m N", "NM", "N⋅m"])
def test_newton_meter_has_many_spellings(text: str) -> None:
    assert parse_unit(text) == Unit("N m", MOMENT, 1.0)


@pytest.mark.parametrize(
    "text", ["in-lbf", "lbf-in", "in lbf", "in.lbf", "inlbf", "lbf.in", "in-lb", "in-lbs", "IN-LBF"]
)
def test_inch_pound_has_many_spellings(text: str) -> None:
    assert parse_unit(text).symbol == "lbf in"


@pytest.mark.parametrize(
    ("text", "expected"),
    [("kN m", 1e3), ("kNm", 1e3), ("N mm", 1e-3), ("Nmm", 1e-3), ("mNm", 1e-3), ("daN.m", 10.0), ("kgf cm", 0.0980665)],
)
def test_prefixes_of_moments(text: str, expected: float) -> None:
    unit = parse_unit(text)
    assert unit.dimension == MOMENT
    assert unit.factor == pytest.approx(expected, rel=1e-12)


def test_prefixes_that_differ_in_case_alone_are_kept_apart() -> None:
    assert parse_unit("mN").factor == 1e-3
    assert parse_unit("MN").factor == 1e6
    with pytest.raises(UserError, match="unknown unit `Mn`"):
        parse_unit("Mn")


def test_meaning_follows_the_dimension() -> None:
    assert parse_unit("g", ACCELERATION).factor == 9.80665
    assert parse_unit("g", MASS).factor == 1e-3
    assert parse_unit("C", TEMPERATURE).symbol == "degC"
    assert parse_unit("pC", CHARGE).factor == 1e-12
    assert parse_unit("lb", FORCE).symbol == "lbf"
    with pytest.raises(UserError, match=r"can be a unit of m/s2 or a unit of kg\. Convert the values to m/s2 or kg"):
        parse_unit("g")
    assert can_be_unit_of("g", MASS) and can_be_unit_of("g", ACCELERATION)
    assert not can_be_unit_of("g", FORCE) and not can_be_unit_of("", MASS) and not can_be_unit_of("Newtn", FORCE)


def test_temperatures() -> None:
    assert parse_unit("°F").to_base(212.0) == pytest.approx(100.0)
    assert parse_unit("degF").to_base(-40.0) == pytest.approx(-40.0)
    assert parse_unit("K", TEMPERATURE).to_base(273.15) == pytest.approx(0.0)
    assert parse_unit("deg C").to_base(20.0) == 20.0


@pytest.mark.parametrize(
    ("mass", "weight"), [("kg", "kgf"), ("Kilograms", "kgf"), ("g", "gf"), ("gram", "gf"), ("grams", "gf")]
)
def test_masses_are_no_loads(mass: str, weight: str) -> None:
    with pytest.raises(UserError, match=f"`{mass}` is a unit of kg.* write {weight} for its weight"):
        parse_unit(mass, FORCE, MOMENT)


def test_all_forces_are_suggested() -> None:
    with pytest.raises(UserError, match=r"Write N, .*lbf.*, gf, kgf$"):
        parse_unit("zentner", FORCE)


@pytest.mark.parametrize("text", ["counts", "bits", "digits", "LSB", "lsb"])
def test_raw_readings_are_numbers(text: str) -> None:
    assert parse_unit(text, VOLTAGE, RATIO, "1").dimension == "1"


def test_wrong_dimension_and_typing_errors_are_named() -> None:
    with pytest.raises(UserError, match="`mm` is a unit of m, where one of N or N m is needed"):
        parse_unit("mm", FORCE, MOMENT)
    with pytest.raises(UserError, match=r"unknown unit `Newtn`.*did you mean"):
        parse_unit("Newtn", FORCE)
    with pytest.raises(UserError, match="unknown unit ``"):
        parse_unit("", FORCE)


@pytest.mark.parametrize("text", ["mV/V", "mV / V", "MV/V"])
def test_bridge_ratio(text: str) -> None:
    assert parse_unit(text, VOLTAGE, RATIO).dimension == RATIO
    assert parse_unit("µV/V").factor == 1e-6


@pytest.mark.parametrize(("text", "other"), [("MV", "mV"), ("Ms", "ms"), ("mPa", "MPa"), ("Mrad", "mrad")])
def test_mega_is_not_taken_for_milli(text: str, other: str) -> None:
    """`MV` was read as millivolts."""
    with pytest.raises(UserError, match=f"the unit `{text}` has the prefix m.*Write {other} if that is meant"):
        parse_unit(text)


@pytest.mark.parametrize(("text", "symbol"), [("Deg C", "degC"), ("deg F", "degF"), ("DEG C", "degC")])
def test_degrees_of_data_loggers_are_read(text: str, symbol: str) -> None:
    assert parse_unit(text, TEMPERATURE).symbol == symbol


@pytest.mark.parametrize(("text", "symbol"), [("mv", "mV"), ("MS", "ms"), ("Min", "min"), ("MPA", "MPa"), ("MM", "mm")])
def test_capitals_that_are_no_prefix_are_read(text: str, symbol: str) -> None:
    assert parse_unit(text).symbol == symbol


def test_other_signals() -> None:
    assert parse_unit("m/s^2").dimension == ACCELERATION
    assert parse_unit("m/s²").dimension == ACCELERATION
    assert parse_unit("1/min") == parse_unit("RPM")
    assert parse_unit("rad/s", FREQUENCY).to_base(2 * math.pi) == pytest.approx(1.0)
    assert parse_unit("counts").dimension == NUMBER
    assert parse_unit("-").dimension == NUMBER


def test_units_in_the_head_of_a_column() -> None:
    assert split_unit("Fx [N]") == ("Fx", "N")
    assert split_unit("Fx (in-lbf)") == ("Fx", "in-lbf")
    assert split_unit("Bridge 1 ((mV)/V)") == ("Bridge 1", "(mV)/V")
    assert split_unit("Fx") == ("Fx", None)
    assert split_unit("Force (N) Run #1") == ("Force Run #1", "N")
    assert split_unit("Force (raw) Run #1") == ("Force (raw) Run #1", None)
    assert split_unit("[N]") == ("[N]", None)


def test_every_spelling_has_one_size_in_a_dimension() -> None:
    sizes: dict[tuple[str, str], set[tuple[float, float]]] = {}
    for spelling, unit in _all_units():
        sizes.setdefault((spelling, unit.dimension), set()).add((unit.factor, unit.offset))
    assert not {key for key, factors in sizes.items() if len(factors) > 1}


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (1.5, VOLTAGE, "1.5 V"),
        (-2.5e-3, VOLTAGE, "-2.5 mV"),
        (4e-9, VOLTAGE, "0.004 uV"),
        (1.25e-3, RATIO, "1.25 mV/V"),
        (-3.2e-6, RATIO, "-3.2 uV/V"),
        (0.0, RATIO, "0 uV/V"),
        (812.0, NUMBER, "812"),
    ],
)
def test_a_reading_in_its_unit(value, unit, text):
    assert short_reading(value, unit) == text
