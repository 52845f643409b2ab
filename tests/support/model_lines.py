"""Lines of a sweep that a model describes exactly, with known noise in channels and load."""

import numpy as np

from balance_cli.model.system_response import solve
from balance_cli.signals.run_spectrum import RunSpectrum
from tests.support.exciter_response import exciter_response

LOAD = 40.0


def model_lines(model, component, column, frequency, noise, rng, delay=0.0):
    """One load component [N, N m] by its column; `noise` is relative, `delay` [s] that of all channels."""
    system = model.system(model.parameters.value)
    volts = LOAD * exciter_response(system, solve(system, frequency, 0.0))[:, :, column]
    volts = volts * np.exp(-2j * np.pi * frequency * delay)[:, None]
    sigma = np.append(noise * np.sqrt(np.mean(np.abs(volts) ** 2, axis=0)), noise * LOAD)
    exact = np.column_stack([volts, np.full(len(frequency), LOAD)])
    z = exact + (rng.standard_normal(exact.shape) + 1j * rng.standard_normal(exact.shape)) * sigma / np.sqrt(2.0)
    return RunSpectrum(
        run=f"sweep-{component}",
        channel_names=model.geometry.channel_names,
        components=(component,),
        frequency=frequency,
        channels=z[:, :-1],
        loads=z[:, -1:],
        covariance=np.broadcast_to(np.diag(sigma**2).astype(complex), (len(frequency), len(sigma), len(sigma))),
        dof=np.inf,
        level=(LOAD,),
    )
