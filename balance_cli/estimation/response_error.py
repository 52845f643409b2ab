"""Error of a model's response: what it misses of the measured ones, by frequency, component and channel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class ResponseError:
    """Error of a model's response beyond the noise: E_j(f) = factor factor* in bands about `frequency` (b,) [Hz].

    `factor` (b, 6, c, r) of the rows of the response, in their order, and the six loads, zero where a load was not
    applied. `channel_names` names the rows: the channels [V/N, V/(N m)], or the sensors of the paper's form and its
    torque channel.
    """

    channel_names: tuple[str, ...]
    frequency: Array
    factor: ComplexArray

    def covariance(self, frequency: Array, loads: ComplexArray) -> ComplexArray:
        """Return the covariance (k, c, c) of the error of T f at frequencies (k,) for loads (k, 6)."""
        band = np.argmin(np.abs(np.log(frequency[:, None] / self.frequency)), axis=1)
        weighted = self.factor[band] * np.abs(loads)[:, :, None, None]
        return np.asarray(np.einsum("kjcr,kjdr->kcd", weighted, weighted.conj()))

    def combine(self, other: ResponseError | None) -> ResponseError:
        """Return the sum of two independent errors of the same rows, in the bands of this one."""
        if other is None:
            return self
        nearest = np.argmin(np.abs(np.log(self.frequency[:, None] / other.frequency)), axis=1)
        return replace(self, factor=np.concatenate([self.factor, other.factor[nearest]], axis=-1))
