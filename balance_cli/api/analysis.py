"""Calibration, frequency responses and identification.

Runs are cross-checked as the commands do it: what they contradict of the geometry and of each other ends the call, or
stands in `consistency` of the result.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated

import numpy as np

from balance_cli.api.arguments import Range, check_arguments
from balance_cli.api.fitted import FittedLike, to_fitted
from balance_cli.api.inputs import (
    GeometryLike,
    RunLike,
    require_band,
    require_disjoint,
    to_geometry,
    to_runs,
)
from balance_cli.calibration.result import Calibration
from balance_cli.calibration.term_choice import TERM_SIGNIFICANCE_LEVEL, choice_of_words, require_known_names
from balance_cli.campaign.rig.load_components import load_components
from balance_cli.diagnosis.consistency.severity import identified_anyway, measured_anyway
from balance_cli.estimation.choices import Damping, Form, Method
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.estimation.measured_responses import add_responses
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.model.balance import check_effects
from balance_cli.model.placed_effects import add_effects
from balance_cli.signals.response.choices import Estimator
from balance_cli.signals.response.transfer import Transfer
from balance_cli.steps import calibrate as calibrate_step
from balance_cli.steps import identify as identify_step
from balance_cli.steps import sweep_tf as sweep_tf_step
from balance_cli.steps.cross_checks import cross_check, cross_check_responses, keep_findings
from balance_cli.steps.trim_agreement import trim_findings


@check_arguments
def calibrate(
    runs: RunLike | Iterable[RunLike],
    geometry: GeometryLike,
    *,
    terms: str | Sequence[str] = "search",
    significance: Annotated[float, Range(0.0, 1.0, is_open=True)] = TERM_SIGNIFICANCE_LEVEL,
    hold_out: RunLike | Iterable[RunLike] = (),
    non_iterative: bool = False,
) -> Calibration:
    """Calibrate a balance from its static runs, as `balance calibrate` does.

    The result has the matrices C0 and T0 of each trim, and one calibration model for all trims: with `terms="search"`
    each channel has the terms that are significant (`significance`: probability of any spurious one), with `"linear"`
    the loads alone, with `"quadratic"` all squares and products, otherwise the listed terms (`["Fx^2", "Fx Fy"]`).
    Static runs of `hold_out` are not fitted and test the prediction intervals. With `non_iterative` the loads are also
    fitted as functions of the readings. Runs of other kinds are ignored. Raises UserError where the runs do not
    determine the matrices, or contradict each other.

    >>> import balance_cli as bal
    >>> calibration = bal.calibrate("sample_data/static-bare.h5", "configs/rts-6.yaml")
    >>> calibration
    Calibration of RTS-6: 1 trim
      bare: 121 rows, condition 7.4, largest residual 0.0326 % FS (Mx)
    >>> calibration.to_frame().loc[:1, ["trim", "channel", "Fx"]].round(5)
       trim    channel       Fx
    0  bare   x.strain  0.00188
    1  bare  y1.strain  0.00004
    """
    rig = to_geometry(geometry)
    fitted, checks = to_runs(runs, rig), to_runs(hold_out, rig)
    require_disjoint(fitted, checks)
    usable = [run for run in checks if run.kind == "static" and run.has_loads]
    choice = choice_of_words(terms, significance)
    require_known_names(choice, rig.channel_names, load_components(rig).names, "")
    findings = cross_check(rig, fitted, measured_anyway)
    result = calibrate_step.calibrate(fitted, rig, choice, usable, non_iterative)
    return keep_findings(result, (*findings, *trim_findings(result)))


@check_arguments
def frequency_response(
    runs: RunLike | Iterable[RunLike],
    geometry: GeometryLike,
    *,
    estimator: Estimator = "auto",
    band: tuple[float, float] = (0.0, np.inf),
) -> Transfer:
    """Estimate frequency responses from the sweeps, as `balance sweep-tf` does.

    `estimator` is one of those of the command, `band` [Hz] the spectral lines that are kept. The result has the
    responses (output/input, exp(+j omega t)) with covariance and coherence. Raises UserError where no run is a sweep,
    or runs contradict each other.

    >>> import balance_cli as bal
    >>> responses = bal.frequency_response("sample_data/sweep-Fz-high.h5", "configs/rts-6.yaml", band=(5, 150))
    >>> responses
    Frequency responses of RTS-6: 1 response to Fz
      581 spectral lines from 5 to 150 Hz, estimator auto
      least coherence 0.9987 (Fz)
    >>> len(responses.to_frame()) == 581 * 15
    True
    """
    require_band(band)
    rig = to_geometry(geometry)
    records = to_runs(runs, rig)
    findings = cross_check(rig, records, measured_anyway)
    return keep_findings(sweep_tf_step.estimate_responses(records, rig, estimator, band), findings)


@check_arguments
def identify(
    runs: FittedLike | Iterable[FittedLike],
    geometry: GeometryLike,
    *,
    effects: Sequence[str] = (),
    method: Method = "ls+ml",
    form: Form = "physical",
    damping: Damping = "diagonal",
    band: tuple[float, float] | None = None,
) -> IdentifiedModel:
    """Identify a mechanical model from sweeps and static runs, as `balance identify` does.

    Frequency responses of `frequency_response`, or imported ones, may stand in place of the sweeps.
    `effects` are fitted beside those that the geometry declares, each written NAME@PLACE,PLACE. With
    `method="computed"` the model is the geometry as declared, and no run is needed. Raises UserError where the runs do
    not allow the fit, or contradict the geometry or each other.

    >>> import balance_cli as bal
    >>> bal.identify([], "configs/rts-6.yaml", method="computed")
    Physical model of RTS-6 (computed)
      7 modes from 23.31 to 76.78 Hz
    >>> sweeps = [f"sample_data/sweep-{name}-high.h5" for name in ("Fx", "Fy", "Fz", "Mx", "My", "Mz")]
    >>> model = bal.identify(sweeps, "configs/rts-6.yaml", method="ls")
    >>> table = model.to_frame().set_index("name")
    >>> print(f"{table.loc['mode 1 frequency', 'value']:.1f} {table.loc['mode 1 frequency', 'unit']}")
    23.3 Hz
    """
    require_band(band)
    rig = to_geometry(geometry)
    check_effects(rig, rig.name)
    rig = add_effects(rig, effects)
    options = identify_step.IdentifyOptions(method=method, form=form, damping=damping, band=band)
    records, responses = to_fitted(runs, rig)
    findings = cross_check(rig, records, identified_anyway)
    findings = (*findings, *cross_check_responses(rig, responses, identified_anyway))
    spectra = add_responses(measured_spectra(records, rig), responses)
    return keep_findings(identify_step.identify(spectra, rig, options), findings)
