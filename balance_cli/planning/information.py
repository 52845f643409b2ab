"""The information of a run about all parameters, in the very likelihood that `identify` and `diagnose` use.

Of a run that was made it is the Gauss-Newton curvature I = 2 Re sum dY* P dY of its likelihood, with its own noise. A
run that is only planned is rehearsed: simulated once with the noise of the plan, its spectra estimated as those of a
record would be, and then treated alike. So the start transient, the number of steady periods, the efficiency of weights
from an estimated covariance and the nonlinear effects at the planned level are all as they will be, without a second
formula for any of them. The information of independent runs adds up (Fedorov, Theory of Optimal Experiments, 1972).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch, split_by_run
from balance_cli.estimation.inner_products import information_product
from balance_cli.estimation.likelihood import batch_curvature, batch_derivatives
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.planning.channel_noise import ChannelNoise
from balance_cli.planning.extended_model import ExtendedModel
from balance_cli.planning.rehearsal import rehearse
from balance_cli.simulation.plans import AnyPlan
from balance_cli.simulation.signal_store import SignalStore

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RunInformation:
    """Information (p, p) of one run about all free parameters; its noise is known to `noise_dof` real dof.

    Of several runs together `parts` are the single ones.
    """

    run: str
    information: Array
    noise_dof: float
    parts: tuple[RunInformation, ...] = ()

    @property
    def single_runs(self) -> tuple[RunInformation, ...]:
        """The runs that add up to this information; this one itself where it is a single run."""
        return self.parts or ((self,) if self.noise_dof > 0 else ())


def no_information(model: ExtendedModel) -> RunInformation:
    """What is known before the first run."""
    return RunInformation("", np.zeros((model.size, model.size)), 0.0)


def spectra_information(spectra: Spectra, model: ExtendedModel) -> tuple[RunInformation, ...]:
    """The information of each run of the spectra."""
    system = model.system
    batches = split_by_run(stack_runs(spectra.lines, spectra.statics, model.model.geometry.channel_names))
    return tuple(
        RunInformation(_run_name(batch), batch_curvature(batch, system).information, batch.runs[0].noise_dof)
        for batch in batches
    )


def band_information(spectra: Spectra, model: ExtendedModel, edges: Array) -> Iterator[Array]:
    """Yield the information (p, p) of the lines of one run in each band, from `edges` (b,) [Hz] on.

    What the start transient and tones of the mains take of it is not taken off.
    """
    (batch,) = split_by_run(stack_runs(spectra.lines, (), model.model.geometry.channel_names))
    item = batch_derivatives(batch, model.system)
    place = np.searchsorted(edges, batch.line_frequency * (1.0 + 1e-9), side="right") - 1
    for k in range(len(edges)):
        yield 2.0 * information_product(item.derivatives[place == k], item.fit.precision[place == k])


def _run_name(batch: Batch) -> str:
    return batch.runs[0].name


def planned_information(
    plan: AnyPlan, store: SignalStore, noise: ChannelNoise, model: ExtendedModel, random_seeds: Iterable[int]
) -> RunInformation:
    """The information that a planned run is expected to give, in the mean of a rehearsal with each seed.

    Phases of the excitation are random, and with them the transient and the periods that are steady: of a short record
    of lightly damped modes a single rehearsal gives a sigma that is off by a tenth. Raises UserError where a record
    would have no usable lines.
    """
    spectra = (rehearse(plan, store, noise, seed) for seed in random_seeds)
    parts = [add_information(spectra_information(each, model), model) for each in spectra]
    return mean_information(parts, plan.run)


def mean_information(parts: Sequence[RunInformation], name: str) -> RunInformation:
    """The mean of several rehearsals of one run."""
    information = np.mean([part.information for part in parts], axis=0)
    return RunInformation(name, information, sum(part.noise_dof for part in parts) / len(parts))


def add_information(parts: Iterable[RunInformation], model: ExtendedModel) -> RunInformation:
    """The information of several independent runs together."""
    total = np.zeros((model.size, model.size))
    runs: list[RunInformation] = []
    for part in parts:
        total = total + part.information
        runs += part.single_runs
    return RunInformation("", total, sum(run.noise_dof for run in runs), tuple(runs))
