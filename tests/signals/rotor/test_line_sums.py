"""The sums over samples against their definition."""

import numpy as np

from balance_cli.signals.rotor.harmonic_noise import line_offsets
from balance_cli.signals.rotor.line_sums import add_lines, unit_powers


def test_unit_powers_are_those_of_the_exponential_function() -> None:
    angle = np.linspace(-40.0, 3000.0, 501)
    expected = np.exp(1j * np.outer(angle, np.arange(49)))
    assert np.abs(unit_powers(angle, 48) - expected).max() < 48 * 3000.0 * np.finfo(float).eps


def test_lines_beside_harmonics_are_the_sums_of_their_definition() -> None:
    rng = np.random.default_rng(3)
    turns, n, samples = 61, 3, 2500
    psi = np.sort(rng.uniform(0.0, 2 * np.pi * turns, samples))
    taper, signals = rng.random(samples), rng.standard_normal((samples, 4))
    orders = line_offsets(turns) / turns
    lines = np.zeros((n + 1, len(orders), 4), complex)
    k = np.arange(n + 1)
    harmonics = np.hstack([np.cos(np.outer(psi, k)), np.sin(np.outer(psi, k[1:]))])
    add_lines(lines, psi / turns, taper, signals, harmonics)
    for harmonic in k:
        expected = (np.exp(-1j * np.outer(harmonic + orders, psi)) * taper) @ signals
        np.testing.assert_allclose(lines[harmonic], expected, atol=1e-10)
