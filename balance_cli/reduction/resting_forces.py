"""Error of mean loads by nonlinear forces, which act on the plate as loads do: no mean reading tells them apart.

A force f along a spring beside the cells shifts the mean readings as the loads w f, w being those that the readings
of one newton along the spring amount to. Two parts of it are not in the static calibration:

- **What rests.** A dry contact at rest holds any force between -F and F. Motion through a span s leaves F - kappa s / 2
  of it, and none where the contact slips both ways. A zero record is at rest, and its state is the end of whatever was
  before. Equally likely forces between -h and h have the standard deviation h / sqrt(3).
- **What vibration shifts.** The mean of f(d) is not f of the mean of d. Of a force that the elongation alone determines
  the model gives the difference, which is taken off the loads; its error is that of the strength of the force. The mean
  of a contact depends on where it slips, which noise makes uncertain: it stays in the loads, as a standard deviation.

Reference: Gaul and Nitsche, Appl. Mech. Rev. 54 (2001) 93 (contacts under dither).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import read_channels
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.mechanics.dual_numbers import constant
from balance_cli.model.mechanics.equations import CellForce
from balance_cli.model.system import System
from balance_cli.model.system_response import response, solve, volts_of_forces
from balance_cli.reduction.mean_loads import MeanLoads
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.signals.run_samples import sample_rate

Array = NDArray[np.float64]

MOTION_ERROR = 0.01
"""Share by which a shift is uncertain beside its strength: the motion is that of a channel of about this accuracy."""
NOTED_SHARE = 1.1
"""Growth of sigma from which a force is named: a tenth is within the error of sigma itself."""


def add_resting_forces(
    loads: MeanLoads, record: RotorRecord, geometry: Geometry, source: ResponseSource, counts_from_zero: bool
) -> MeanLoads:
    """Return mean loads without the shift by nonlinear forces of the response's model, and with their error in sigma.

    `counts_from_zero`: whether they count from a zero record, in which a dry contact rested. Without one the scatter of
    the zeros of the calibration holds that.
    """
    if not isinstance(source, ModelSource) or not source.system.equations.forces or np.isnan(loads.loads).all():
        return loads
    columns = [COMPONENTS.index(name) for name in loads.components]
    shift, variance, notes = np.zeros(len(columns)), loads.sigma**2, []
    for force in _mean_forces(record, source, geometry, counts_from_zero):
        w = force.loads[columns]
        shift, variance = shift + w * force.known, variance + (w * force.sigma) ** 2
        notes.append(force.description)
    if not notes:
        return loads
    sigma = np.sqrt(variance)
    matters = np.any(sigma > NOTED_SHARE * loads.sigma) or np.any(np.abs(shift) > loads.sigma)
    note = "; ".join(filter(None, [loads.note, *(notes if matters else ())]))
    return replace(loads, loads=loads.loads - shift, sigma=sigma, note=note)


@dataclass(frozen=True)
class _MeanForce:
    """What a nonlinear force adds to a mean: the `known` part [N], sigma of the rest, hub `loads` (6,) per newton."""

    place: str
    known: float
    sigma: float
    loads: Array

    @property
    def description(self) -> str:
        """The error in one sentence."""
        taken = f"a shift of {self.known:.2g} N is taken off" if self.known else "none of it is known"
        return f"nonlinear force at {self.place} in the mean loads: {taken}, {self.sigma:.2g} N is in sigma"


def _mean_forces(
    record: RotorRecord, source: ModelSource, geometry: Geometry, counts_from_zero: bool
) -> Iterator[_MeanForce]:
    """Each nonlinear force that is not zero."""
    # Linear models need neither.
    from balance_cli.estimation.cell_forces import record_force_histories
    from balance_cli.signals.waveforms import record_waveform

    run, live = record.recorded or record.run, record.health.live
    waveform = record_waveform(read_channels(run, live), sample_rate(run), live, geometry)
    for force, d, f in record_force_histories(waveform, source.system, run.rotor_speed or 0.0):
        place, loads = source.system.equations.springs[force.spring], _equivalent_loads(source.system, force)
        # The contribution that was removed from the channels has no mean over the record, whatever part is reduced.
        values, mean = force.values.value, float(f.mean())
        if force.held is None:
            shift = mean - _force_at_rest(force, float(d.mean()))
            strength = force.values.derivative[:, 0]
            error = float(np.sqrt(strength @ source.parameter_covariance @ strength)) / abs(float(values[0]))
            yield _MeanForce(place, shift, abs(shift) * float(np.hypot(error, MOTION_ERROR)), loads)
        else:
            held = [force.held(values, float(np.ptp(d))), *([force.held(values, 0.0)] if counts_from_zero else [])]
            yield _MeanForce(place, 0.0, float(np.sqrt(mean**2 + sum(h**2 for h in held) / 3.0)), loads)


def _force_at_rest(force: CellForce, d: float) -> float:
    """The force [N] at a constant elongation [m]."""
    values = constant(force.values.value, 0)
    shape = force.shape(constant(np.array([d]), 0), values, True)
    return float((values[0] * shape).value[0])


def _equivalent_loads(system: System, force: CellForce) -> Array:
    """Hub loads (6,) [N, N m] that shift the mean readings as one newton of a force does, by least squares."""
    at_rest = solve(system, np.zeros(1))
    acting, read = (volts[0, :, force.spring].real for volts in volts_of_forces(system, at_rest))
    volts = acting + read if force.read else acting
    return np.asarray(np.linalg.lstsq(response(system, at_rest)[0].real, volts, rcond=None)[0])
