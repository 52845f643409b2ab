"""The load-to-channel response that `reduce` inverts, with its own uncertainty: its interface, and measured responses.

A source answers two questions: what T (h, c, 6) is at h frequencies, and what covariance T f has for estimated loads f,
because the effect of a response error is proportional to the load. Responses of models are in `model_sources`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.channel_health import ChannelHealth, live_channels
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.response_error import ResponseError
from balance_cli.io.errors import UserError
from balance_cli.model.plate import moment_reference_length
from balance_cli.model.system import System
from balance_cli.reduction.response_description import ResponseDescription, ResponseKind, response_text

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

ASSUMED_DECAY = 3.0
"""Time constant [s] where a response does not tell its modes: that of a mode at 5 Hz with a damping ratio of 1 %."""


REACH_OF_SWEEPS = 0.03
"""Of a frequency, by which a model reaches beyond its last line: the width of a mode of 1.5 % damping."""


@dataclass(frozen=True)
class ChannelCombination:
    """How rows of a response are formed from the live channels.

    `rows` (r,) are indices of rows of the response; `combination` (h, r, c) forms them, at h frequencies, from c live
    channels.
    """

    rows: list[int]
    combination: ComplexArray

    @property
    def rows_are_channels(self) -> bool:
        """Whether each row is one of the live channels, in their order."""
        rows, channels = self.combination.shape[1:]
        return rows == channels and np.array_equal(self.combination[0], np.eye(channels))


class ResponseSource(Protocol):
    """A response at any frequency; its rows are channels, or sensors that are formed from channels."""

    @property
    def description(self) -> str:
        """What the response is, in a few words."""
        ...

    @property
    def system(self) -> System | None:
        """The equations of motion behind the response, which reduction in time needs; None where it has none."""
        ...

    @property
    def poles(self) -> tuple[complex, ...]:
        """Eigenvalues [1/s] of the oscillating modes, upper half plane, of a response without equations of motion."""
        ...

    @property
    def slowest_decay(self) -> float:
        """Time constant [s] of the slowest decay of the balance, as far as the source knows it."""
        ...

    @property
    def swept_band(self) -> tuple[float, float] | None:
        """Band [Hz] beyond which no sweep tells of a model; None of a response that ends with what was measured."""
        ...

    @property
    def response_error(self) -> ResponseError | None:
        """What the response is known to miss of measured ones; None where it misses nothing or that is not known."""
        ...

    @property
    def is_contradicted(self) -> bool:
        """Whether the data that the response was made from contradict it or the filter, and its error is not known."""
        ...

    @property
    def untrusted_channels(self) -> dict[str, str]:
        """Channels that a diagnosis has found to contradict the others, with the reason; no load rests on them."""
        ...

    def channel_combination(self, frequency: Array, live: tuple[str, ...]) -> ChannelCombination:
        """Return how the rows are formed from the live channels at `frequency` (h,) [Hz]."""
        ...

    def at(self, frequency: Array, spin: float) -> ComplexArray:
        """Return the response (h, rows, 6) at `frequency` (h,) [Hz] and rotor speed `spin` [Hz]."""
        ...

    def remove_nonlinear_contribution(self, run: Run, live: tuple[str, ...]) -> Run:
        """Return the run without the contribution of nonlinear cell forces; itself where the response is linear."""
        ...

    def covariance(self, frequency: Array, spin: float, loads: ComplexArray) -> Array:
        """Return the covariance (h, 2 rows, 2 rows) of [Re, Im] of T f for loads (h, 6), from the error of T."""
        ...


def select_channels(names: Sequence[str], live: Sequence[str], count: int) -> ChannelCombination:
    """Return the live ones among the rows, which are the channels `names`, at `count` frequencies."""
    known = [name for name in live if name in names]
    pick = np.zeros((len(known), len(live)))
    pick[np.arange(len(known)), [list(live).index(name) for name in known]] = 1.0
    combination = np.broadcast_to(pick.astype(complex), (count, *pick.shape))
    return ChannelCombination([list(names).index(name) for name in known], combination)


def stacked_real(matrix: ComplexArray) -> Array:
    """Return the real form [[Re, -Im], [Im, Re]] (..., 2a, 2b) of complex matrices (..., a, b)."""
    upper = np.concatenate([matrix.real, -matrix.imag], axis=-1)
    return np.concatenate([upper, np.concatenate([matrix.imag, matrix.real], axis=-1)], axis=-2)


def circular_real(covariance: ComplexArray) -> Array:
    """Return the covariance of [Re, Im] of circular noise x with E[x x*] = `covariance` (..., c, c)."""
    return np.asarray(0.5 * stacked_real(covariance))


def usable_channels(run: Run, geometry: Geometry, source: ResponseSource) -> ChannelHealth:
    """Return the channels of a run that can be used with a response; raises UserError where there is none."""
    health = live_channels(run, geometry).without(source.untrusted_channels)
    if not health.live:
        name, reason = next(iter(health.left_out.items()), ("", "the geometry declares none"))
        fault = f"no channel is usable ({f'{name}: ' if name else ''}{reason})"
        raise UserError(fault, run.file, "channels", "Repair the channels, or leave the run out")
    return health


def no_state_space_error(method: str, path: str = "") -> UserError:
    """Return the error of a reduction in time by a response that has no state space."""
    return UserError(
        "the response has no state space, which reduction in time needs",
        path,
        f"--method {method}",
        "Give --model with a model of the physical form (`balance identify` without --form paper), "
        "or use --method harmonic",
    )


class ResponseWithoutModel:
    """What all responses share that no model describes: they are linear, and no diagnosis has judged them."""

    @property
    def note(self) -> str:
        """What is to be known of loads by this response; empty where there is nothing."""
        return ""

    def at_spin(self, spin: float) -> ResponseSource:
        """Return the response itself: it does not know the rotor speed."""
        return cast(ResponseSource, self)

    @property
    def untrusted_channels(self) -> dict[str, str]:
        """None: no diagnosis has judged the channels."""
        return {}

    @property
    def swept_band(self) -> tuple[float, float] | None:
        """None: no model continues the response beyond what was measured."""
        return None

    @property
    def system(self) -> System | None:
        """None: there are no equations of motion."""
        return None

    @property
    def poles(self) -> tuple[complex, ...]:
        """None: the response does not tell its modes."""
        return ()

    def remove_nonlinear_contribution(self, run: Run, live: tuple[str, ...]) -> Run:
        """Return the run itself: the response is linear."""
        return run


def beyond_sweeps(source: ResponseSource, frequency: Array) -> NDArray[np.bool_]:
    """Return which frequencies (h,) [Hz] lie outside the sweeps of a model; none where the source has no such band.

    A model continues its response there, but a mode of a part that the sweeps did not reach is not in it: an absorber
    of 0.08 kg at 80 Hz on a plate of 120 kg, swept to 45 Hz, made loads 89 standard deviations wrong, and no residual
    shows it.
    """
    low, high = source.swept_band or (0.0, np.inf)
    return np.asarray(
        (frequency > 0.0) & ((frequency < (1.0 - REACH_OF_SWEEPS) * low) | (frequency > (1.0 + REACH_OF_SWEEPS) * high))
    )


def at_rotor_speed(source: ResponseSource, spin: float) -> ResponseSource:
    """Return the response that belongs to runs at a rotor speed [Hz]; a model knows all of them."""
    return source.at_spin(spin) if isinstance(source, ResponseWithoutModel) else source


@dataclass(frozen=True)
class StaticSource(ResponseWithoutModel):
    """The static matrix C0 at every frequency, as if the balance had no dynamics."""

    channel_names: tuple[str, ...]
    C0: Array
    slowest_decay: float = ASSUMED_DECAY

    @property
    def response_error(self) -> ResponseError | None:
        """None: no dynamic measurement is compared with it."""
        return None

    @property
    def is_contradicted(self) -> bool:
        """Always: it leaves out the dynamics that every balance has at the harmonics."""
        return True

    @property
    def description(self) -> str:
        """That it is the static matrix."""
        return response_text(ResponseDescription(ResponseKind.STATIC))

    def channel_combination(self, frequency: Array, live: tuple[str, ...]) -> ChannelCombination:
        """Return the rows, which are the strain and torque channels."""
        return select_channels(self.channel_names, live, len(frequency))

    def at(self, frequency: Array, spin: float) -> ComplexArray:
        """Return C0, the same at every frequency."""
        return np.broadcast_to(self.C0.astype(complex), (len(frequency), *self.C0.shape))

    def covariance(self, frequency: Array, spin: float, loads: ComplexArray) -> Array:
        """Return zeros: what this matrix neglects is not noise."""
        count = 2 * len(self.channel_names)
        return np.zeros((len(frequency), count, count))


def load_scale(hub: Sequence[float]) -> Array:
    """Return factors (6,) [1, 1/m] that make moments comparable with forces: 1 and one over the height of the hub."""
    arm = moment_reference_length(hub)
    return np.array([1.0, 1.0, 1.0, 1.0 / arm, 1.0 / arm, 1.0 / arm])


def static_source(calibration: Calibration) -> ResponseSource:
    """Return C0 of the first trim over the strain and torque channels."""
    trim = next(iter(calibration.trims.values()))
    C0 = np.zeros((len(trim.channel_names), 6))
    C0[:, [COMPONENTS.index(name) for name in trim.components]] = trim.C0
    return StaticSource(trim.channel_names, C0)
