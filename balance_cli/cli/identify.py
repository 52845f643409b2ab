"""`balance identify`: fit the balance model to sweeps and static runs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.model_summary import declared_summary, effect_summary, modes_summary, parameters_summary
from balance_cli.cli.options import InputFile, band_option, geometry_option, output_option, skip_bad_option
from balance_cli.estimation.choices import DAMPING_FORMS, FORMS, METHODS, Damping, Form, Method
from balance_cli.io.formats import MODEL_FORMAT
from balance_cli.io.percent import percent_text

if TYPE_CHECKING:
    from balance_cli.estimation.identified_model import FitQuality, IdentifiedModel, RunFit

# Factor on every sigma above which the summary warns of a misfit: sigma is rarely known to better than 10 %.
MIN_MISFIT_SCALE = 1.1


@balance_command("identify")
@geometry_option
@click.argument("runs", type=InputFile(), nargs=-1, metavar="[RUN...]")
@click.option(
    "--method",
    type=click.Choice(METHODS),
    default="ls+ml",
    show_default=True,
    help="Least squares (equation error), maximum likelihood, both; or the geometry as computed, without a fit.",
)
@click.option(
    "--form",
    type=click.Choice(FORMS),
    default="physical",
    show_default=True,
    help="Physical parameters with priors; or the six-sensor state form of the 1985 paper.",
)
@click.option(
    "--damping",
    type=click.Choice(DAMPING_FORMS),
    default="diagonal",
    show_default=True,
    help="Damping matrix of the paper's form.",
)
@click.option(
    "--effect",
    "effects",
    multiple=True,
    metavar="NAME[@PLACE[,PLACE]]",
    help="An effect beyond the rigid balance to be fitted, besides those that the geometry declares (repeatable).",
)
@band_option("Use lines within this band only [Hz]; the paper's form has 10 125 without it.")
@skip_bad_option
@output_option("MODEL")
def command(
    session: Session,
    geometry: Path,
    runs: tuple[Path, ...],
    method: Method,
    form: Form,
    damping: Damping,
    effects: tuple[str, ...],
    band: tuple[float, float] | None,
    skip_bad: bool,
    output: Path,
) -> None:
    """Identify the mechanical model from sweeps and static runs, or from measured frequency responses.

    RUN may be a file of `sweep-tf` or `import-frf`, in place of its sweeps. Runs of other kinds are left out and named.
    With --method computed no run is needed: the model is the geometry.
    """
    from balance_cli.cli.consistency import with_findings
    from balance_cli.cli.fitted_files import fitted_spectra, read_fitted_files
    from balance_cli.model.balance import check_effects
    from balance_cli.model.placed_effects import add_effects
    from balance_cli.steps.identify import IdentifyOptions, identify

    rig = session.geometry(geometry)
    check_effects(rig, str(geometry))
    rig = add_effects(rig, effects)
    spectra = fitted_spectra(session, read_fitted_files(session, runs, rig, skip_bad), rig)
    options = IdentifyOptions(method=method, form=form, damping=damping, band=band)
    with session.working("fit"):
        model = identify(spectra, rig, options)
    session.save(output, MODEL_FORMAT, with_findings(session, model))
    session.finish(model_summary(model), model_text(model))


def model_summary(model: IdentifiedModel) -> dict[str, Any]:
    """Return the JSON summary, with the keys of docs/json.md."""
    from balance_cli.steps.identify import identified_effects

    quality = model.quality
    return {
        "form": model.form,
        "method": model.method,
        "start": model.start,
        "converged": model.converged,
        "iterations": model.iterations,
        "modes": modes_summary(model.modes),
        "chi2_per_dof": quality.chi2_per_dof,
        "frf_error": quality.frf_error,
        "frf_band": quality.frf_band,
        "band": model.band,
        "runs": {name: _run_fit_summary(run) for name, run in quality.runs.items()},
        "parameters": parameters_summary(model.parameters),
        "declared": declared_summary(model),
        "effects": [effect_summary(effect) for effect in identified_effects(model)],
        "undetermined": model.unidentifiable,
        "channels_left_out": model.channels_left_out,
    }


def _run_fit_summary(run: RunFit) -> dict[str, float | str | None]:
    """Return the JSON summary of the fit of one run."""
    numbers = {"chi2": run.chi2, "dof": run.dof, "frf_error": run.frf_error, "frf_noise": run.frf_noise_floor}
    return {**numbers, "worst_channel": run.worst_channel}


def _misfit_text(quality: FitQuality) -> str:
    """Return that a model does not describe its data, with the run and the channel that it misses most."""
    said = "The model does not describe these data: the uncertainties below are underestimated"
    name = quality.worst_run
    if not name:
        return said
    run = quality.runs[name]
    channel = f", there channel {run.worst_channel}" if run.worst_channel else ""
    return f"{said}. It misses {name} most (chi2/dof {run.chi2 / run.dof:.4g}){channel}"


def model_text(model: IdentifiedModel) -> Iterator[str]:
    """Yield the lines of the console summary: modes, quality of the fit, effects, unidentifiable directions."""
    from balance_cli.estimation.declared_departures import declared_agreement
    from balance_cli.steps.identify import identified_effects

    quality, modes = model.quality, model.modes
    yield f"{model.form} form, {model.method}, {model.iterations} iterations from {model.start}"
    if not model.converged:
        yield "NOT CONVERGED: the result is preliminary"
    if quality.runs:
        yield f"chi2/dof {quality.chi2_per_dof:.4g} against the measured noise"
        yield f"error of all responses {percent_text(quality.frf_error, 3)} %"
    if model.misfit_scale > MIN_MISFIT_SCALE:
        yield _misfit_text(quality)
    for departure in declared_agreement(model).departures:
        yield f"NOT AS DECLARED: {departure.description}"
    yield "   Hz         sigma      damping    sigma"
    for row in zip(modes.frequency, modes.sigma_frequency, modes.damping_ratio, modes.sigma_damping_ratio, strict=True):
        yield "{:9.4f} {:9.2g} {:9.5f} {:9.2g}".format(*row)
    for effect in identified_effects(model):
        yield f"{effect.label}:"
        for item in effect.parameters:
            yield f"   {item.name:<20} {item.value:12.5g} +- {item.sigma:<9.2g} {item.unit}"
    for direction in model.unidentifiable:
        yield f"common change that only the declared tolerances determine: {direction}"
