"""Lines of a rig that no model of the project describes: modes with drawn shapes, channels with known noise."""

from dataclasses import replace

import numpy as np

from balance_cli.signals.run_spectrum import RunSpectrum, StaticPoints
from tests.support.rigs import rotor_balance

RIG = rotor_balance()
NAMES = RIG.channel_names
SPRINGS = (*RIG.cell_names, None)
FREQUENCY = np.arange(8, 601) * 0.25
MODES = np.array([21.3, 27.4, 38.9, 54.2, 71.7, 88.8, 118.0])
DAMPING = 0.008
NOISE = 2e-4
LOAD_NOISE = 1e-3


def shapes(component: str) -> np.ndarray:
    """Residues (modes, springs) of the forces' response to a component [N/N]."""
    rng = np.random.default_rng(["Fx", "Fy", "Fz", "Mx", "My", "Mz"].index(component))
    return rng.normal(size=(len(MODES), len(SPRINGS)))


def forces(component: str, frequency: np.ndarray, modes: np.ndarray = MODES) -> np.ndarray:
    """Forces (k, springs) along the springs per unit load."""
    ratio = np.asarray(frequency)[:, None] / modes
    return (1.0 / (1.0 - ratio**2 + 2j * DAMPING * ratio)) @ shapes(component)


def declared_gain(name: str, frequency: np.ndarray) -> np.ndarray:
    """The gain (k,) of a channel as its geometry says."""
    channel = RIG.channels[NAMES.index(name)]
    s = 2j * np.pi * np.asarray(frequency)
    gain = np.full(len(s), channel.sensitivity, complex)
    if channel.lowpass is not None:
        gain /= 1 + s / (2 * np.pi * channel.lowpass)
    if channel.time_constant is not None:
        gain *= s * channel.time_constant / (1 + s * channel.time_constant)
    return gain


def response(component: str, frequency: np.ndarray, modes: np.ndarray = MODES) -> np.ndarray:
    """Response (k, c) [V/N] of all channels."""
    force = forces(component, frequency, modes)
    springs = [SPRINGS.index(channel.cell) for channel in RIG.channels]
    return force[:, springs] * np.stack([declared_gain(name, frequency) for name in NAMES], axis=1)


def noise_covariance(u: int, rng: np.random.Generator) -> np.ndarray:
    """Covariance (c+u, c+u) of correlated channels; the loads' noise is their own."""
    c = len(NAMES)
    mix = np.eye(c) + 0.3 * rng.normal(size=(c, c)) / np.sqrt(c)
    covariance = np.zeros((c + u, c + u))
    covariance[:c, :c] = NOISE**2 * mix @ mix.T
    covariance[c:, c:] = LOAD_NOISE**2 * np.eye(u)
    return covariance


def circular_noise(rng: np.random.Generator, covariance: np.ndarray, count: int) -> np.ndarray:
    root = np.linalg.cholesky(covariance)
    white = rng.normal(size=(count, len(root))) + 1j * rng.normal(size=(count, len(root)))
    return white @ root.T / np.sqrt(2)


def swept_lines(
    component: str = "Fz",
    level: float = 10.0,
    seed: int = 0,
    modes: np.ndarray = MODES,
    changed: dict[str, np.ndarray] | None = None,
    dof: float = np.inf,
    noise: float = 1.0,
    **changes: object,
) -> RunSpectrum:
    """One sweep; `changed` {channel: factor (k,)}. With finite `dof` the covariance is an estimate from as many."""
    rng = np.random.default_rng(seed)
    U = level * np.exp(2j * np.pi * rng.random((len(FREQUENCY), 1)))
    Y = response(component, FREQUENCY, modes) * U
    for name, factor in (changed or {}).items():
        Y[:, NAMES.index(name)] *= factor
    covariance = noise**2 * noise_covariance(1, rng)
    z = np.concatenate([Y, U], axis=1) + circular_noise(rng, covariance, len(FREQUENCY))
    if np.isfinite(dof):
        sample = circular_noise(rng, covariance, int(dof))
        covariance = sample.T @ sample.conj() / dof
    lines = RunSpectrum(
        run=f"sweep-{component}-{level:g}-{seed}",
        channel_names=NAMES,
        components=(component,),
        frequency=FREQUENCY,
        channels=z[:, :-1],
        loads=z[:, -1:],
        covariance=np.broadcast_to(covariance.astype(complex), (len(FREQUENCY), *covariance.shape)),
        dof=dof,
        level=(level,),
    )
    return replace(lines, **changes)


def static(factor: np.ndarray | float = 1.0, seed: int = 0, noise: float = 1e-4) -> StaticPoints:
    """Every component up and down; `factor` (c,) on the true response at rest, with an offset and noise per row."""
    rng = np.random.default_rng(seed + 1000)
    ramp = np.concatenate([np.linspace(0, 1, 6), np.linspace(1, -1, 11), np.linspace(-1, 0, 6)])
    loads = np.concatenate([np.outer(300.0 * ramp, np.eye(6)[j]) for j in range(6)])
    dc = [name for name in NAMES if RIG.channels[NAMES.index(name)].measures_dc]
    places = [NAMES.index(name) for name in dc]
    zero = np.array([0.0])
    C0 = np.stack([response(name, zero)[0, places].real for name in ("Fx", "Fy", "Fz", "Mx", "My", "Mz")], axis=1)
    rows = loads @ (C0.T * factor) + 0.3 + noise * rng.normal(size=(len(loads), len(dc)))
    return StaticPoints("static", "bare", tuple(dc), rows, loads, noise**2 * np.eye(len(dc)), 60.0)
