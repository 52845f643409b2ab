"""Error of the azimuth that an import finds in a sampled tachometer, against the true azimuth.

`python -m studies.tachometer` prints the table of docs/import.md; with `--write` it replaces it there.
"""

import sys
from pathlib import Path

import numpy as np
import scipy.signal
from scipy.ndimage import uniform_filter1d

from balance_cli.signals.rotor.low_pass_lag import AnalogLowPass
from balance_cli.signals.rotor.tachometer import TachometerSettings, read_rotor_reference
from balance_cli.simulation.rotor import RotorKinematics

PAGE = Path(__file__).parents[1] / "docs" / "import.md"
MARKS = ("<!-- tachometer study -->\n", "<!-- end of tachometer study -->\n")
ROTOR = RotorKinematics(17.5, drift=0.01)
DURATION, NOISE, SWING, ORDER = 30.0, 0.05, 5.0, 6
FINE_RATE = 4e5
EDGE_SAMPLES = 8
"""Of the fine rate over which an edge rises: 20 us, 0.13 deg."""
PULSES = {"pulse of 18 deg": 0.05, "pulse of 108 deg": 0.3}
RATES = (51200.0, 20000.0, 5000.0, 1000.0)


def sampled_tachometer(rate: float, width: float, noise: float, seed: int) -> tuple[np.ndarray, AnalogLowPass]:
    """Samples [V] of the tachometer behind its low-pass, and the low-pass."""
    fine = int(np.ceil(FINE_RATE / rate))
    time = np.arange(int(DURATION * rate * fine)) / (rate * fine)
    turns = ROTOR.azimuth(time) / (2 * np.pi)
    level = uniform_filter1d((turns % 1.0 < width).astype(float), EDGE_SAMPLES)
    low_pass = AnalogLowPass(ORDER, 0.4 * rate)
    sections = scipy.signal.butter(ORDER, low_pass.cutoff, fs=rate * fine, output="sos")
    samples = scipy.signal.sosfilt(sections, level)[::fine]
    return SWING * (samples + noise * np.random.default_rng(seed).standard_normal(len(samples))), low_pass


def azimuth_errors(times: np.ndarray) -> np.ndarray:
    """Azimuth [deg] at the pulses less whole revolutions."""
    return (np.degrees(ROTOR.azimuth(times)) + 180.0) % 360.0 - 180.0


def study_row(rate: float, name: str) -> str:
    """One row of the table."""
    samples, low_pass = sampled_tachometer(rate, PULSES[name], NOISE, 0)
    found = read_rotor_reference(lambda a, b: samples[a:b], len(samples), rate, TachometerSettings(low_pass=low_pass))
    errors = azimuth_errors(found.pulse_times)
    above = samples > 0.5 * SWING
    naive = azimuth_errors((np.flatnonzero(above[1:] & ~above[:-1]) + 1) / rate)
    stated = f"{found.scatter_deg:.2g} | {found.azimuth_error_deg:.2g}"
    true = f"{errors.std():.2g} | {errors.mean():+.1g} | {np.abs(errors).max():.2g}"
    return f"| {rate / 1000:g} kHz | {name} | {stated} | {true} | {naive.std():.2g} | {naive.mean():+.2g} |"


def table() -> str:
    """The table, in Markdown."""
    head = "| sampled at | mark | scatter of a pulse [deg] | stated | true: std | mean | largest | naive: std | mean |"
    rows = [study_row(rate, name) for rate in RATES for name in PULSES]
    return "\n".join([head, "|---" * 9 + "|", *rows]) + "\n"


if __name__ == "__main__":
    text = table()
    print(text)
    if "--write" in sys.argv:
        page = PAGE.read_text(encoding="utf-8")
        before, rest = page.split(MARKS[0])
        PAGE.write_text(f"{before}{MARKS[0]}\n{text}\n{MARKS[1]}{rest.split(MARKS[1])[1]}", encoding="utf-8")
