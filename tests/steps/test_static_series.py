"""Zeros of load series that no file states are in no line of a static run that a fit sees."""

import numpy as np
import pytest

from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.estimation.static_lines import static_lines
from balance_cli.signals.run_spectrum import StaticPoints
from balance_cli.steps.static_series import with_load_series

RAMP = np.array([0, 1, 2, 3, 4, 3, 2, 1, 0]) / 4
SERIES = np.repeat(np.arange(6), len(RAMP))
LOADS = np.vstack([np.outer(RAMP, [900.0, 900.0, 3000.0, 400.0, 500.0, 300.0][j] * np.eye(6)[j]) for j in range(6)])
MATRIX = np.random.default_rng(4).standard_normal((7, 6)) * 2e-3
NOISE = 1e-4


def points(zeros: float, seed: int, cubic: float = 0.0) -> StaticPoints:
    """Seven channels [V] with noise, and zeros of this size [V] for each load series, which no file states."""
    rng = np.random.default_rng(seed)
    channels = LOADS @ MATRIX.T + NOISE * rng.standard_normal((len(LOADS), 7))
    channels += zeros * rng.standard_normal((6, 7))[SERIES] + cubic * (LOADS / 900.0) ** 3 @ MATRIX.T
    names = tuple(f"c{i}" for i in range(7))
    return StaticPoints("static", "bare", names, channels, LOADS, NOISE**2 * np.eye(7), 30.0)


def fitted(item: StaticPoints) -> StaticPoints:
    (result,) = with_load_series(Spectra((), (item,), {}, {})).statics
    return result


def misfit(item: StaticPoints) -> float:
    """Largest departure of the slopes from the matrix, in sigma."""
    lines = static_lines(item)
    columns = [("Fx", "Fy", "Fz", "Mx", "My", "Mz").index(name) for name in lines.components]
    departure = lines.channels.real - lines.loads.real @ MATRIX[:, columns].T
    return float(np.max(np.abs(departure) / np.sqrt(lines.covariance[:, 0, 0].real)[:, None]))


@pytest.mark.parametrize("zeros", [2e-3, 2e-2, 1.0])
def test_series_whose_zeros_differ_are_found(zeros: float) -> None:
    """Chi-square of a sound static run had been 44 to 4400 per degree of freedom, and diagnose left the run out."""
    item = points(zeros, 1)
    found = fitted(item)
    assert found.series is not None and np.array_equal(found.series, SERIES)
    assert misfit(found) < 4.5 < 0.2 * misfit(item)


def test_a_run_with_one_zero_keeps_it() -> None:
    """Further zeros would cost information; a nonlinear channel has none either."""
    runs = [points(0.0, seed) for seed in range(30)]
    assert all(fitted(item) is item for item in runs)
    assert fitted(points(0.0, 3, cubic=0.05)).series is None


def test_stated_series_stay() -> None:
    item = points(2e-3, 5)
    stated = StaticPoints(**{**vars(item), "series": np.zeros(len(LOADS), np.intp)})
    assert fitted(stated) is stated
