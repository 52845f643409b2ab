"""What a channel's own declared high-pass still rings in the lines of a periodic record.

The amplifier begins in balance with what it first sees, and not where the steady motion would have its slow state. What
is missing there decays as exp(-t/T), T the time constant: seconds, and short records are no longer. A line of N samples
of step h from t_f to t_e holds of it, per volt at t = 0,

    (2/N) (exp(-t_f/T) - exp(-t_e/T)) / (1 - exp(-(1/T + j w) h)).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.equations import ChannelPath
from balance_cli.signals.lines import Lines

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]


def ringing(run: Lines, path: ChannelPath, at: Index) -> ComplexArray:
    """Lines `at` (k,) of one volt of it at t = 0; zero where the channel has no high-pass or the record none of it."""
    window = run.window
    if window is None or not path.high_pass:
        return np.zeros(len(at), complex)
    rate, start = path.high_pass[0].value, window.start[at]
    decay = np.exp(-rate * start) - np.exp(-rate * window.stop)
    turn = np.exp(-(rate + 2j * np.pi * run.frequency[at]) * window.step)
    return np.asarray(2.0 * window.step / (window.stop - start) * decay / (1.0 - turn), complex)


def usual_ringing(run: Lines, path: ChannelPath) -> float:
    """Rms [V] at t = 0: that of the channel, whose motion begins anywhere in its period."""
    if not path.high_pass:
        return 0.0
    volts = run.channels[run.frequency > 0, run.channel_names.index(path.channel)]
    return float(np.sqrt(0.5 * np.sum(np.abs(volts) ** 2)))
