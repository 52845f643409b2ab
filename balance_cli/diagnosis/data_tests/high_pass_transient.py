"""The transient of a channel's declared high-pass in the lines of a periodic record.

The amplifier starts in equilibrium with its first input, not in the state of the periodic motion. The difference decays
as exp(-t/T) with the time constant T of seconds, which is the length of short records. A line of N samples of step h
from t_f to t_e contains, per volt at t = 0,

    (2/N) (exp(-t_f/T) - exp(-t_e/T)) / (1 - exp(-(1/T + j w) h)).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.mechanics.equations import ChannelPath
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]


def high_pass_transient(run: RunSpectrum, path: ChannelPath, at: Index) -> ComplexArray:
    """Lines `at` (k,) of a transient of one volt at t = 0; zero without a high-pass or without a window."""
    window = run.window
    if window is None or not path.high_pass:
        return np.zeros(len(at), complex)
    rate, start = path.high_pass[0].value, window.start[at]
    decay = np.exp(-rate * start) - np.exp(-rate * window.stop)
    turn = np.exp(-(rate + 2j * np.pi * run.frequency[at]) * window.step)
    return np.asarray(2.0 * window.step / (window.stop - start) * decay / (1.0 - turn), complex)


def typical_transient_rms(run: RunSpectrum, path: ChannelPath) -> float:
    """Rms [V] of the transient at t = 0: that of the channel, because the phase of its motion is arbitrary."""
    if not path.high_pass:
        return 0.0
    volts = run.channels[run.frequency > 0, run.channel_names.index(path.channel)]
    return float(np.sqrt(0.5 * np.sum(np.abs(volts) ** 2)))


def remove_transients(change: ComplexArray, precision: ComplexArray, columns: tuple[ComplexArray, ...]) -> ComplexArray:
    """A change (k, c) of responses without the transients of each run's channels, weighted by `precision` (k, c, c).

    `columns` (k, c): for each run the transient of each channel at its typical size. Its actual size, with sign, is one
    number for all lines, with a standard deviation of one.
    """
    c = change.shape[1]
    R = np.concatenate(columns, axis=1)
    P = np.tile(precision, (1, len(columns), len(columns)))
    weighted = np.tile(np.matmul(precision, change[:, :, None])[:, :, 0], (1, len(columns)))
    normal = 2.0 * np.real(np.sum(R.conj()[:, :, None] * P * R[:, None, :], axis=0)) + np.eye(R.shape[1])
    size = np.linalg.solve(normal, 2.0 * np.real(np.sum(R.conj() * weighted, axis=0)))
    return np.asarray(change - np.sum((R * size).reshape(len(R), len(columns), c), axis=1))
