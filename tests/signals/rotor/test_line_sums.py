"""The sums over samples against their definition."""

import tracemalloc

import numpy as np
import pytest

from balance_cli.signals.rotor import line_sums
from balance_cli.signals.rotor.harmonic_noise import line_offsets
from balance_cli.signals.rotor.line_sums import LineSums, unit_powers


def test_unit_powers_are_those_of_the_exponential_function() -> None:
    angle = np.linspace(-40.0, 3000.0, 501)
    expected = np.exp(1j * np.outer(np.arange(49), angle))
    assert np.abs(unit_powers(angle, 48) - expected).max() < 48 * 3000.0 * np.finfo(float).eps


@pytest.mark.parametrize("turns, blocks", [(61, 1), (61, 7), (10, 3)])
@pytest.mark.parametrize("first", [0, 17])
def test_lines_beside_harmonics_are_the_sums_of_their_definition(turns: int, blocks: int, first: int) -> None:
    rng = np.random.default_rng(3)
    n, samples = 3, 2500
    revolution = first + np.sort(rng.uniform(0.0, turns, samples))
    signals = rng.standard_normal((samples, 4))
    lines = turns * np.arange(n + 1)[:, None] + line_offsets(turns).astype(int)
    sums = LineSums(int(lines.max()), 4)
    for part in np.array_split(np.arange(samples), blocks):
        sums.add(revolution[part] / turns, signals[part])
    expected = np.exp(-2j * np.pi * lines[..., None] * revolution / turns) @ signals
    np.testing.assert_allclose(sums.at(lines), expected, atol=1e-12 * np.abs(signals).sum())


def test_a_weak_line_beside_a_strong_one_keeps_its_digits() -> None:
    """Noise is a millionth of a harmonic beside it; the kernel must keep them apart."""
    turns, samples = 400, 20000
    revolution = np.linspace(0.0, turns, samples, endpoint=False)
    signal = np.cos(2 * np.pi * revolution) + 1e-9 * np.cos(2 * np.pi * (turns + 5) / turns * revolution)
    sums = LineSums(2 * turns, 1)
    sums.add(revolution / turns, signal[:, None])
    assert sums.at(np.array([turns + 5]))[0, 0].real == pytest.approx(0.5e-9 * samples, rel=1e-3)


def test_the_columns_of_a_long_record_are_transformed_a_few_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    sums, lines = LineSums(20000, 12), np.arange(-5, 20000, 500)
    rng = np.random.default_rng(5)
    sums.add(np.sort(rng.uniform(size=4000)), rng.standard_normal((4000, 12)))
    together, memory = sums.at(lines), 8 * 12 * 80000
    monkeypatch.setattr(line_sums, "TRANSFORMED_POINTS", 200000)
    tracemalloc.start()
    np.testing.assert_array_equal(sums.at(lines), together)
    assert tracemalloc.get_traced_memory()[1] < 0.5 * memory
    tracemalloc.stop()
