"""Measured responses of a rig as they would be without any error but noise."""

import numpy as np

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.reduction.measured_response import TransferSource
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.signals.run_spectrum import FrequencyResponse

NOISE = 1e-4
"""Of a line, over the largest of the channel."""


def measured_responses(model: ModelSource, rig: Geometry) -> TransferSource:
    """The response to each load at lines 1 Hz apart, more than the width of most modes, with noise."""
    frequency, rng = np.arange(1.0, 161.0), np.random.default_rng(5)
    exact, names = model.at(frequency, 0.0), rig.channel_names
    responses = []
    for j, name in enumerate(COMPONENTS):
        sigma = NOISE * np.abs(exact[:, :, j]).max(axis=0)
        sigma = np.maximum(sigma, 1e-3 * sigma.max())  # cells do not read Mz, and have noise all the same
        noise = sigma * (rng.standard_normal((2, len(frequency), len(names))).T @ [1.0, 1j]).T / np.sqrt(2.0)
        shape = (len(frequency), len(names), 1)
        covariance = np.broadcast_to(np.diag(sigma**2).astype(complex), (*shape[:2], len(names)))
        unit = np.ones((len(frequency), 1, 1), complex)
        value = (exact[:, :, j] + noise)[:, :, None]
        args = ("periodic", frequency, value, covariance, unit, np.ones(shape), np.ones(shape[:2]))
        responses.append(FrequencyResponse(f"sweep-{name}", names, (name,), *args))
    return TransferSource(names, tuple(responses), "local")
