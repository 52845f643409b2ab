"""Channels that are late against the loads, found from the phase of their responses without a model of the rig.

Far from a resonance a lightly damped rig moves in phase with the load or against it, at either end of every mode, so
that a squared response is positive there. A delay turns it by twice its phase, at all lines alike:

    J(tau) = mean of Re (h exp(j w tau))^2,        h = H / |H|

is near one at the delay of the channel, however many periods of the lines it is, and falls off on both sides. A fit
from no delay ends in the minimum next to it; from here it begins at the right one. All late channels of a box begin
together: one after another, each would be fitted beside the false parameters of the rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.channel_groups import channel_groups
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.data_tests.channel_pairs import declared_paths
from balance_cli.diagnosis.fit_settings import LateChannelSettings
from balance_cli.diagnosis.search.candidates import Candidate, candidates
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.model.channel_gains import channel_gains
from balance_cli.model.effects import Effect
from balance_cli.model.effects.places import channels_at
from balance_cli.model.mechanics.equations import ChannelPath
from balance_cli.model.placed_effects import declared_effects
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def late_channels(runs: Sequence[RunSpectrum], geometry: Geometry, settings: SearchSettings) -> tuple[Candidate, ...]:
    """Return a delay, started there, of each channel whose phase shows one, and of each group of which all do alike.

    Runs whose loads were applied together tell nothing here. Channels that have a delay already are left out.
    """
    limits = settings.late_channels
    pool = [item for item in candidates(geometry, excluded=settings.excluded) if _is_delay(item.effect)]
    at = {item.placed_effect.where[0]: item for item in pool}
    present = [item.where for item in declared_effects(geometry) if _is_delay(item.effect)]
    known = {name for where in present for name in channels_at(geometry, where)}
    alone = [name for name in geometry.channel_names if name in at and name not in known]
    paths = {path.channel: path for path in declared_paths(geometry)}
    delays = {name: _delay_of(at[name], runs, paths[name], limits) for name in alone}
    late = {name: delay for name, delay in delays.items() if delay is not None}
    found, groups = list[Candidate](), channel_groups(geometry)
    for group in sorted(groups, key=lambda name: -len(groups[name])):
        values = [late[name] for name in groups[group] if name in late]
        if group in at and len(values) == len(groups[group]) and np.ptp(values) < _resolution(runs, limits):
            found.append(_started_at(at[group], float(np.median(values))))
            late = {name: delay for name, delay in late.items() if name not in groups[group]}
    return (*found, *(_started_at(at[name], delay) for name, delay in late.items()))


def _started_at(item: Candidate, delay: float) -> Candidate:
    ratio = item.effect.search.channel_ratio
    assert ratio is not None
    return Candidate(item.placed_effect, (ratio.start(delay),))


def _resolution(runs: Sequence[RunSpectrum], limits: LateChannelSettings) -> float:
    """Difference [s] of delays that their starts leave open: phases near resonances turn them by a tenth of a cycle."""
    return 2.0 * limits.step / max(float(run.frequency.max()) for run in runs)


def _is_delay(effect: Effect) -> bool:
    """Whether an effect turns the phase of a channel in proportion to the frequency, and does nothing else."""
    ratio = effect.search.channel_ratio
    return ratio is not None and ratio.log_ratio(np.array([1j, 2j]), 1.0).tolist() == [-1j, -2j]


def _delay_of(
    item: Candidate, runs: Sequence[RunSpectrum], path: ChannelPath, limits: LateChannelSettings
) -> float | None:
    """The delay [s] of the channel of a candidate, within its bounds; None where the phase shows none."""
    far = max(parameter.upper for parameter in item.placed_effect.parameters)
    parts = [_squared_phases(path, run, limits) for run in runs if path.channel in run.channel_names]
    frequency, squared = (np.concatenate([part[i] for part in parts] or [np.zeros(0)]) for i in (0, 1))
    if len(frequency) < limits.min_lines:
        return None
    delays = np.arange(-far, far, limits.step / frequency.max())
    # Runs have the same frequencies, of which there are fewer than lines.
    distinct, place = np.unique(frequency, return_inverse=True)
    summed = np.bincount(place, squared.real) + 1j * np.bincount(place, squared.imag)
    score = np.array([np.sum((summed * np.exp(4j * np.pi * distinct * delay)).real) for delay in delays])
    score /= len(frequency)
    best, at_rest = int(np.argmax(score)), float(np.mean(squared.real))
    is_clear = (
        score[best] > limits.min_coherence and score[best] - at_rest > limits.min_gain and 0 < best < len(delays) - 1
    )
    return float(delays[best]) if is_clear else None


def _squared_phases(path: ChannelPath, run: RunSpectrum, limits: LateChannelSettings) -> tuple[Array, ComplexArray]:
    """Frequencies (k,) and squares (k,) of the unit phasors of a channel against the load of a run.

    Lines count where both are clear. The declared gain of the channel is taken out. None of several loads at once.
    """
    i, count = run.channel_names.index(path.channel), len(run.channel_names)
    if len(run.components) != 1:
        return np.zeros(0), np.zeros(0, complex)
    amplitude = np.stack([run.channels[:, i], run.loads[:, 0]])
    noise = np.sqrt(np.stack([run.covariance[:, j, j].real for j in (i, count)]))
    clear = (run.frequency > 0) & np.all(np.abs(amplitude) > limits.min_signal_to_noise * noise, axis=0)
    frequency, (response, load) = run.frequency[clear], amplitude[:, clear]
    phasor = response / load / channel_gains((path,), frequency)[:, 0]
    return frequency, np.asarray((phasor / np.abs(phasor)) ** 2)
