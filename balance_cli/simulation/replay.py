"""Channels of a rig under recorded loads: a free simulation, which uses nothing of what the channels measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.simulation.acquisition import KINDS_WITH_LOADS, true_loads
from balance_cli.simulation.assembly import equations_of_motion
from balance_cli.simulation.channel_volts import sampled_volts
from balance_cli.simulation.load_signals import CONTACT_OVERSAMPLING, OVERSAMPLING
from balance_cli.simulation.motion import RigDynamics, nonlinear_forces
from balance_cli.simulation.rig import TrueRig

Array = NDArray[np.float64]


HALF_LENGTH, KAISER_SHAPE = 64, 14.0
"""Samples on either side, and shape of the window, of the interpolation: to 1e-6 up to 0.92 of half the sample rate.
With the kernel that scipy takes by itself, of ten samples, amplitudes are wrong by up to 0.2 %."""


def replay_loads(rig: TrueRig, loads: Array, kind: str, sample_rate: float, rotor_speed: float = 0.0) -> Array:
    """Volts (n, channels) of a rig under the recorded `loads` (n, 6) of a run of this kind, from rest under the first.

    Loads are band-limited between samples. They were recorded behind the anti-alias filter, which is the same for
    channels and loads, so the channels need no further filter. An effect with a random phase has another one here.
    Raises LinAlgError where the motion grows without bound.
    """
    from scipy.signal import firwin, resample_poly  # see `integrate.first_order_recursion`

    has_exciters = kind in KINDS_WITH_LOADS
    attached = [name for name, load in zip(COMPONENTS, loads.T, strict=True) if has_exciters and np.any(load)]
    mechanics = equations_of_motion(rig, rotor_speed, attached)
    oversampling = CONTACT_OVERSAMPLING if any(force.has_kinks for force in mechanics.forces) else OVERSAMPLING
    step = 1.0 / (oversampling * sample_rate)
    taps = 2 * HALF_LENGTH * oversampling + 1
    kernel = firwin(taps, 1.0 / oversampling, window=("kaiser", KAISER_SHAPE))
    fine = resample_poly(  # type: ignore[call-overload]  # the stubs know no kernel
        loads, oversampling, 1, axis=0, padtype="line", window=kernel
    )
    # What interpolation leaves in a component without load would be a load.
    fine = np.where(np.any(loads, axis=0), fine, 0.0)
    for extension in reversed(rig.extensions):
        fine = extension.loads_from_recorded(fine, kind, step)
    fine = true_loads(rig, fine, kind)
    motion = RigDynamics.from_mechanics(mechanics)
    with np.errstate(over="ignore", invalid="ignore"):
        forces = nonlinear_forces(motion, [fine], step)[0] if mechanics.forces else np.zeros((len(fine), 0))
        if not np.isfinite(forces).all():
            raise np.linalg.LinAlgError("the motion grows without bound")
        inputs = np.hstack([fine, forces])
        return sampled_volts(rig, motion, inputs, step, oversampling, None, np.random.default_rng(0))
