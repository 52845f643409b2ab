"""A rig whose response is known exactly: lightly damped modes as digital filters, driven from rest, with known noise.

Nothing of the project computes it: the records come from `scipy.signal.lfilter`, the response from `freqz`.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy import signal

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.components import COMPONENTS

RATE = 400.0
MODES = (20.3, 31.7, 46.2, 77.1, 118.4)
NOISE = 1.2e-3
LOAD_NOISE = 0.02


@dataclass(frozen=True)
class SweptRig:
    """Channels from components through some modes [Hz] of damping ratio `zeta`; noise is per sample."""

    channels: int = 5
    components: tuple[str, ...] = ("Fx",)
    zeta: float = 0.005
    noise: float = NOISE
    load_noise: float = LOAD_NOISE
    rate: float = RATE
    modes: tuple[float, ...] = MODES
    shapes: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(7)
        size = len(self.modes), self.channels, len(self.components)
        object.__setattr__(self, "shapes", 0.004 * rng.normal(size=size))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"c{i}" for i in range(self.channels))

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """Exact response (k, c, u)."""
        z = 2 * np.pi * np.asarray(frequency) / self.rate
        filters = map(self._filter, self.modes)
        return sum(signal.freqz(*one, z)[1][:, None, None] * p for one, p in zip(filters, self.shapes, strict=True))

    def record(self, loads: np.ndarray, seed: int, **attributes: object) -> Run:
        """What is recorded when `loads` (n, u) act on the rig at rest."""
        rng = np.random.default_rng(seed)
        y = np.zeros((len(loads), self.channels))
        for f, p in zip(self.modes, self.shapes, strict=True):
            y += signal.lfilter(*self._filter(f), loads, axis=0) @ p.T
        measured = np.zeros((len(loads), 6))
        columns = [COMPONENTS.index(name) for name in self.components]
        measured[:, columns] = loads + self.load_noise * rng.normal(size=loads.shape)
        source = MemorySource(y + self.noise * rng.normal(size=y.shape), measured)
        return Run("run", "rig", "sweep", self.names, len(y), source, sample_rate=self.rate, excited=self.components,
                   level=(40.0,) * len(self.components), **attributes)  # fmt: skip

    def multisine(self, seed: int = 0, period: float = 4.0, periods: int = 7, spin_up: int = 0) -> Run:
        """Random-phase multisine from 2 to 150 Hz; the record begins `spin_up` periods after the rig was at rest."""
        n = round(period * self.rate)
        loads = np.tile(multisine(n, self.rate, len(self.components), seed), (periods + spin_up, 1))
        run = self.record(loads, seed, excitation="multisine", period=period)
        block = run.read(spin_up * n)
        source = MemorySource(block.channels, block.loads)
        return Run(**{**run.__dict__, "samples": len(block.channels), "source": source})

    def random(self, seed: int = 0, seconds: float = 28.0) -> Run:
        """Gaussian noise, 2 to 150 Hz."""
        rng = np.random.default_rng(seed + 100)
        sos = signal.butter(6, (2, 150), "band", fs=self.rate, output="sos")
        x = signal.sosfilt(sos, rng.normal(size=(int(seconds * self.rate) + 2000, len(self.components))), axis=0)
        return self.record(40.0 * x[2000:] / x.std(axis=0), seed, excitation="random")

    def sine_sweep(self, seed: int = 0, seconds: float = 28.0) -> Run:
        """Linear sine sweep, 2 to 150 Hz; a second component sweeps down."""
        t = np.arange(int(seconds * self.rate)) / self.rate
        up = np.sqrt(2) * 40.0 * signal.chirp(t, 2, t[-1], 150)
        loads = np.stack([up[:: (-1) ** j] for j in range(len(self.components))], axis=1)
        return self.record(loads, seed, excitation="sine-sweep")

    def stepped(self, seed: int = 0, seconds: float = 10.0, steps: int = 36) -> Run:
        """Sines of one frequency after the other, 2 to 140 Hz, each with smooth changes in a tenth of its time."""
        position = np.arange(int(seconds * self.rate)) / (seconds * self.rate) * steps
        step, inside = np.floor(position).astype(int), position % 1.0
        phase = 2 * np.pi * np.geomspace(2, 140, steps)[step] * inside * seconds / steps
        edge = np.sin(np.pi / 2 * np.clip(10.0 * np.minimum(inside, 1.0 - inside), 0.0, 1.0)) ** 2
        loads = np.sqrt(2) * 40.0 * np.sin(phase) * edge
        return self.record(np.repeat(loads[:, None], len(self.components), axis=1), seed, excitation="stepped")

    def _filter(self, frequency: float) -> tuple[np.ndarray, np.ndarray]:
        w = 2 * np.pi * frequency
        b, a, _ = signal.cont2discrete(([w * w], [1, 2 * self.zeta * w, w * w]), 1 / self.rate, "foh")
        return b.ravel(), a


def multisine(samples: int, rate: float, components: int, seed: int) -> np.ndarray:
    """One period (samples, components) of lines from 2 to 150 Hz, rms 40."""
    rng = np.random.default_rng(seed + 50)
    spectrum = np.zeros((samples // 2 + 1, components), complex)
    lines = np.arange(int(2 * samples / rate), int(150 * samples / rate) + 1)
    spectrum[lines] = np.exp(2j * np.pi * rng.random((len(lines), components)))
    x = np.fft.irfft(spectrum, samples, axis=0)
    return 40.0 * x / x.std(axis=0)


def near_mode(frequency: np.ndarray, reach: float) -> np.ndarray:
    """Whether each frequency is within `reach` [Hz] of a mode."""
    return np.min(np.abs(np.asarray(frequency)[:, None] - np.array(MODES)), axis=1) < reach


def relative_error(rig: SweptRig, frequency: np.ndarray, response: np.ndarray) -> np.ndarray:
    """Error (k,) over the true response, rms over the channels."""
    truth = rig.response(frequency)
    return np.linalg.norm(response - truth, axis=(1, 2)) / np.linalg.norm(truth, axis=(1, 2))


def chi2_per_dof(rig: SweptRig, lines) -> np.ndarray:
    """Chi-square per degree of freedom (k,) of `Y - T U` at the true T, by the covariance that the lines state."""
    T = rig.response(lines.frequency)
    c = rig.channels
    e = lines.channels - np.einsum("kcu,ku->kc", T, lines.loads)
    combine = np.concatenate([np.broadcast_to(np.eye(c), (len(T), c, c)), -T], axis=2)
    covariance = combine @ lines.covariance @ combine.conj().swapaxes(1, 2)
    correction = (lines.dof - c) / lines.dof
    return np.einsum("kc,kcd,kd->k", e.conj(), np.linalg.inv(covariance), e).real / c * correction
