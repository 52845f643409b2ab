"""The sample rate in the heads of text files."""

import numpy as np
import pytest

from balance_cli.campaign.recording.import_map import ImportMap
from balance_cli.campaign.recording.import_map_file import declared_runs
from balance_cli.importers import open_foreign
from balance_cli.importers.stated_clock import stated_rates
from balance_cli.steps.import_runs import import_run
from balance_cli.steps.import_sketch import sketch_map


@pytest.mark.parametrize(
    ("line", "rate"),
    [
        ("Sample Rate: 1000 sps", 1000.0),
        ("TIMESERIES BW_RJOB__EHZ_D, 6001 samples, 200 sps, 2009-08-24T00:20:03.000000, SLIST", 200.0),
        ("Sample rate: 2 kS/s", 2000.0),
        ("Sampling Rate: 1 MHz", 1e6),
        ("Sampling rate [S/s]\t2000", 2000.0),
        ("samples per second = 1000", 1000.0),
        ("Sample rate 1.0E+03", 1000.0),
        ("Sample rate: 1 000 Hz", 1000.0),
        ("Abtastrate: 2,5 kHz", 2500.0),
        ("sample_rate_hz = 500", 500.0),
        ("Scan Rate,,1000", 1000.0),
        ("DELTA: 2.50e-02", 40.0),
        ("Delta: 1 ms", 1000.0),
        ("DELTA;0,0005", 2000.0),
        ("Delta_X,0.001,0.001,0.001", 1000.0),
        ("Sample Interval: 0.5 msec", 2000.0),
        ("Time Step: 100 \N{MICRO SIGN}s", 1e4),
        ("SAMPLING INTERVAL (S)  .0025", 400.0),
    ],
)
def test_a_rate_is_read_with_its_unit(line, rate):
    assert stated_rates(["Wind tunnel 3", line, "Kanal 1"]) == pytest.approx((rate,), rel=1e-15)


@pytest.mark.parametrize(
    "line",
    [
        "Sampling Frequency 1,000 Hz",
        "Fs: 1,000,000",
        "Sample rate 1.000,5",
        "Sample rate: 12:30:11",
        "Sample rate 0 Hz",
        "default sample rate\tDMS_1",
        "Frequency 50 Hz",
        "Rated load 500",
        "Number of samples: 5000",
        "Delta 3 bar",
        "delta_x 0.5 V",
        "dt=1e400",
        "dt=0",
    ],
)
def test_what_is_ambiguous_or_no_rate_is_none(line):
    assert stated_rates([line]) == ()


@pytest.mark.parametrize(
    ("line", "rates"),
    [
        ('"SampleRate",1.000000E+03,1.000000E+03', (1000.0,)),
        ("SampleRate,5.12E+04,5.12E+04", (51200.0,)),
        ('"Sampling Rate","5.12E+04","5.12E+04"', (51200.0,)),
        ("SampleRate,51200,51200", (51200.0,)),
        ("SampleRate,50000.0,50000.0", (50000.0,)),
        ("SampleRate,1000,500", (1000.0, 500.0)),
        ("SampleRate,1000,,500", (1000.0, 500.0)),
        ("Sample rate [kHz],2.5,2.5,1", (2500.0, 1000.0)),
        ("Sample rate,2.5 kHz,1 kHz", (2500.0, 1000.0)),
        ("Sample rate,1000,Hz,16,bit", (1000.0,)),
        ("Sample rate: 1000, 6001 samples", (1000.0,)),
        ("Sample rate,1000,2024-03-12,10:11:12", (1000.0,)),
        ("Sample Interval,4.00E-05,4.00E-05", (25000.0,)),
        ("Sample Interval,0.001,0.002", (1000.0, 500.0)),
    ],
)
def test_a_comma_between_cells_is_none_within_a_number(line, rates):
    """The mantissa alone was taken (1 Hz for 1.0E+03), or the second number for decimals (1000.5 Hz)."""
    assert stated_rates([line], ",") == pytest.approx(rates, rel=1e-15)


@pytest.mark.parametrize(
    ("line", "rates"),
    [
        ("Abtastrate;1000,5;1000,5", (1000.5,)),
        ("Abtastrate\t1000\t500", (1000.0, 500.0)),
        ("Abtastrate;2,4 kHz;;", (2400.0,)),
        ("Sample rate 1.0E+03 1.0E+03", (1000.0,)),
        ("Sample rate 1000 500", (1000.0, 500.0)),
        ("Sample rate 1000 Hz 16 bit", (1000.0,)),
        ("Abtastrate;1000;Hz;500;Hz", (1000.0, 500.0)),
        ("Abtastrate: 1000, 500", (1000.0, 500.0)),
        ("Abtastrate;5,12E+04;5,12E+04", (51200.0,)),
        ("DT;0,001;0,002", (1000.0, 500.0)),
    ],
)
@pytest.mark.parametrize("separator", ["", ";", "\t", " "])
def test_other_separators_leave_decimal_commas(line, rates, separator):
    assert stated_rates([line], separator) == pytest.approx(rates, rel=1e-15)


def imported(path, **clock):
    runs = [{"file": "*", "kind": "zero", "run": "zero-1"}]
    mapping = {"format": "balance-import/1", "rig": "r", "runs": runs, "channels": {"F1": "z1"}} | clock
    (declared,) = declared_runs(ImportMap.model_validate(mapping), [path], "map")
    return import_run(declared, [open_foreign(path)])


@pytest.mark.parametrize(
    ("name", "unit", "cell", "said"),
    [
        ("Time", "d", lambda t: f"{45363.4 + t / 86400:.10f}", "time: Time\ntime_unit: TODO"),
        ("ts_ms", "ms", lambda t: f"{1710238272000 + 1000 * t:.0f}", "time: ts_ms\ntime_unit: ms"),
        ("millis", "ms", lambda t: f"{123456 + 1000 * t:.0f}", "time: millis\ntime_unit: ms"),
        ("micros", "us", lambda t: f"{123456 + 1e6 * t:.0f}", "time: micros\ntime_unit: us"),
        ("%time", "ns", lambda t: f"{1609060336768428032 + int(1e9 * t)}", "time: time\ntime_unit: ns"),
        ("timestamp", "ms", lambda t: f"{1710238272000 + 1000 * t:.1f}", "time: timestamp\ntime_unit: ms"),
        ("time_ns", "ns", lambda t: f"{1e9 * t:.0f}", "time: time_ns\ntime_unit: ns"),
    ],
)
def test_dates_of_spreadsheets_and_counters_are_times(tmp_path, name, unit, cell, said):
    """A counter of milliseconds was a channel, and days were no unit."""
    rows = "".join(f"{cell(k / 1000)},{np.sin(k):.6f}\n" for k in range(600))
    (tmp_path / "record.csv").write_text(f"{name},F1 [V]\n{rows}")
    assert imported(tmp_path / "record.csv", time=name.lstrip("%"), time_unit=unit).run.sample_rate == 1000.0
    assert said in sketch_map([open_foreign(tmp_path / "record.csv")], None)


@pytest.mark.parametrize(
    ("stated", "clock", "note"),
    [
        (2000, {"time": "t"}, "the file states 2000 Hz, its times `t` 1000 Hz, which was taken"),
        (1000, {"time": "t"}, ""),
        (2000, {"sample_rate": 1000.0}, "the file states 2000 Hz, the map 1000 Hz, which was taken"),
        (1000, {"sample_rate": 1000.0}, ""),
        ("1000,500", {"time": "t"}, ""),
    ],
)
def test_an_import_names_a_rate_in_the_head_that_contradicts_the_one_taken(tmp_path, stated, clock, note):
    """Only the sketch did."""
    rows = "".join(f"{k / 1000:.3f},{np.sin(k):.6f}\n" for k in range(60))
    (tmp_path / "record.csv").write_text(f"SampleRate,{stated}\nt [s],F1 [V]\n{rows}")
    found = imported(tmp_path / "record.csv", **clock)
    assert found.run.sample_rate == 1000.0
    assert found.notes == ((f"record.csv: {note}",) if note else ())
