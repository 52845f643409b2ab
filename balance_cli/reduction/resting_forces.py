"""Error of mean loads by nonlinear forces, which act on the plate as loads do: no mean reading tells them apart.

A force f along a spring beside the cells shifts the mean readings as the loads w f, w being those that the readings
of one newton along the spring amount to. Two parts of it are not in the static calibration:

- **What rests.** A dry contact at rest holds any force between -F and F. Motion through a span s leaves F - kappa s / 2
  of it, and none where the contact slips both ways. A zero record is at rest, and its state is the end of whatever was
  before. Equally likely forces between -h and h have the standard deviation h / sqrt(3).
- **What vibration shifts.** The mean of f(d) is not f of the mean of d. Of a force that the elongation alone determines
  the model gives the difference, which is taken off the loads; its error is that of the strength of the force. The mean
  of a contact depends on where it slips, which noise makes uncertain: it stays in the loads, as a standard deviation.
- **What the calibration smooths.** No polynomial has the kinks of a stop: f of the mean of d is not what the
  calibration has of it. That is what its readings have beyond those of the linear model, T x + (T w) f at the loads x.

Reference: Gaul and Nitsche, Appl. Mech. Rev. 54 (2001) 93 (contacts under dither).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.run import read_channels
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.mechanics.cell_force import CellForce, CellMotion
from balance_cli.model.mechanics.dual_numbers import constant
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
    loads: MeanLoads,
    record: RotorRecord,
    calibration: Calibration,
    source: ResponseSource,
    counts_from_zero: bool,
) -> MeanLoads:
    """Return mean loads without the shift by nonlinear forces of the response's model, and with their error in sigma.

    `calibration`: that which gave the loads. `counts_from_zero`: whether they count from a zero record, in which a dry
    contact rested. Without one the scatter of the zeros of the calibration holds that.
    """
    if not isinstance(source, ModelSource) or not source.system.equations.forces or np.isnan(loads.loads).all():
        return loads
    columns = [COMPONENTS.index(name) for name in loads.components]
    shift, variance, notes = np.zeros(len(columns)), loads.sigma**2, []
    calibrated = partial(_calibrated_force, loads, calibration, source.system)
    for force in _mean_forces(record, source, calibration.geometry, counts_from_zero, calibrated):
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
    record: RotorRecord,
    source: ModelSource,
    geometry: Geometry,
    counts_from_zero: bool,
    calibrated: Callable[[CellForce], tuple[float, float]],
) -> Iterator[_MeanForce]:
    """Each nonlinear force that is not zero; `calibrated` tells what the calibration has of one."""
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
            at_rest, rest_error = _force_at_rest(force, float(d.mean())), 0.0
            uncertain = mean - at_rest
            if force.has_kinks and not force.needs_rate:
                uncertain, (at_rest, rest_error) = mean, calibrated(force)
            strength = force.values.derivative[:, 0]
            error = float(np.sqrt(strength @ source.parameter_covariance @ strength)) / abs(float(values[0]))
            sigma = float(np.hypot(uncertain * np.hypot(error, MOTION_ERROR), rest_error))
            yield _MeanForce(place, mean - at_rest, sigma, loads)
        else:
            held = [force.held(values, float(np.ptp(d))), *([force.held(values, 0.0)] if counts_from_zero else [])]
            yield _MeanForce(place, 0.0, float(np.sqrt(mean**2 + sum(h**2 for h in held) / 3.0)), loads)


def _force_at_rest(force: CellForce, d: float) -> float:
    """The force [N] at a constant elongation [m]."""
    motion = CellMotion.at_rest(constant(np.array([d]), 0), is_periodic=True)
    return float(force.along(motion, constant(force.values.value, 0)).value[0])


def _calibrated_force(
    loads: MeanLoads, calibration: Calibration, system: System, force: CellForce
) -> tuple[float, float]:
    """What the calibration has [N] of a force at mean loads, and its error.

    The error is that of readings by the linear model which no such force explains.
    """
    columns = [COMPONENTS.index(name) for name in loads.components]
    names, volts, full = _calibrated_readings(loads, calibration)
    rows = [calibration.geometry.channel_names.index(name) for name in names]
    T = response(system, solve(system, np.zeros(1)))[0].real[np.ix_(rows, columns)]
    unit = np.max(np.abs(T * full), axis=1)
    excess, w = (volts - T @ loads.loads) / unit, _force_volts(system, force)[rows] / unit
    size = float(w @ excess / (w @ w))
    left = excess - w * size
    return size, float(np.sqrt(left @ left / max(len(w) - 1, 1) / (w @ w)))


def _calibrated_readings(loads: MeanLoads, calibration: Calibration) -> tuple[tuple[str, ...], Array, Array]:
    """Channels and readings (c,) [V] that the calibration has for the mean loads; the calibrated range (k,)."""
    trim, all_trims = calibration.trims.get(loads.trim), calibration.all_trims
    if trim is not None:
        return trim.channel_names, trim.C0 @ loads.loads, trim.calibrated_range
    assert all_trims is not None
    model, level = all_trims.loads_model, all_trims.level_weight_loads
    with_weight, weight = model.readings(np.stack([level + loads.loads, level]))
    return model.channel_names, with_weight - weight, model.calibrated_range


def _equivalent_loads(system: System, force: CellForce) -> Array:
    """Hub loads (6,) [N, N m] that shift the mean readings as one newton of a force does, by least squares."""
    T = response(system, solve(system, np.zeros(1)))[0].real
    return np.asarray(np.linalg.lstsq(T, _force_volts(system, force), rcond=None)[0])


def _force_volts(system: System, force: CellForce) -> Array:
    """Readings (c,) [V] at rest of one newton of a force."""
    acting, read = (volts[0, :, force.spring].real for volts in volts_of_forces(system, solve(system, np.zeros(1))))
    return np.asarray(acting + read if force.read else acting)
