"""The command `balance sweep-tf`: frequency responses of the sweeps, with covariance."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.options import (
    NumberRange,
    check_band,
    geometry_option,
    output_option,
    runs_argument,
    skip_bad_option,
)
from balance_cli.io.formats import TRANSFER_FORMAT
from balance_cli.signals.response.choices import ESTIMATORS

if TYPE_CHECKING:
    from balance_cli.signals.response.transfer import Transfer
    from balance_cli.signals.run_spectrum import FrequencyResponse


@balance_command("sweep-tf")
@geometry_option
@click.option(
    "--estimator",
    type=click.Choice(ESTIMATORS),
    default=ESTIMATORS[0],
    show_default=True,
    help="auto: ratio of lines for periodic sweeps, local rational model (lrm) for others; lpm: local polynomial.",
)
@click.option("--from", "lowest", type=NumberRange(min=0), metavar="HZ", help="Lowest frequency wanted.")
@click.option("--to", "highest", type=NumberRange(min=0), metavar="HZ", help="Highest frequency wanted.")
@runs_argument
@skip_bad_option
@output_option("TF")
def command(
    session: Session,
    geometry: Path,
    estimator: str,
    lowest: float | None,
    highest: float | None,
    runs: tuple[Path, ...],
    skip_bad: bool,
    output: Path,
) -> None:
    """Estimate the frequency responses of sweeps, with covariance."""
    from balance_cli.cli.consistency import require_consistent_runs, with_findings
    from balance_cli.diagnosis.consistency.severity import measured_anyway
    from balance_cli.steps.sweep_tf import estimate_responses

    band = (lowest or 0.0, float("inf") if highest is None else highest)
    check_band("--from, --to", *band)
    rig = session.geometry(geometry, mechanics=False)
    opened = session.runs(runs, rig, skip_bad)
    opened = require_consistent_runs(session, rig, opened, skip_bad, measured_anyway)
    transfer = estimate_responses(
        opened, rig, estimator, band, lambda sweeps: session.progress(sweeps, "responses", len(sweeps), False)
    )
    with session.collect_messages():
        _report_runs(session, transfer)
    session.save(output, TRANSFER_FORMAT, with_findings(session, transfer))
    session.finish(transfer_summary(transfer), response_lines(transfer))


def _report_runs(session: Session, transfer: Transfer) -> None:
    """Say which runs and channels are not used, which sweeps disagree, and where the transient has not ended."""
    for text in transfer.consistency or ():
        session.warn(text)
    for name, reason in transfer.unused_runs.items():
        session.report_left_out(name, reason)
    for run, channels in transfer.channels_left_out.items():
        for name, reason in channels.items():
            session.warn_of_run(run, f"run {run}: channel {name} left out: {reason}")
    for run, part in transfer.steady_parts.items():
        if not part.steady:
            text = "the transient has not ended before the last two periods; the covariance includes what is left of it"
            session.warn_of_run(run, f"run {run}: {text}")


def transfer_summary(transfer: Transfer) -> dict[str, Any]:
    """Return the JSON summary of frequency responses, with the keys of docs/json.md."""
    from balance_cli.signals.response.transfer import least_coherence, response_components

    return {
        "geometry": transfer.geometry.name,
        "estimator": transfer.estimator,
        "runs": {response.run: _response_summary(response) for response in transfer.responses},
        "steady": transfer.steady_parts,
        "channels_left_out": transfer.channels_left_out,
        "coherence_min": least_coherence(transfer),
        "relative_sigma": {name: _median_relative_sigma(transfer, name) for name in response_components(transfer)},
    }


def _response_summary(response: FrequencyResponse) -> dict[str, Any]:
    return {
        "components": response.components,
        "level": response.level,
        "estimator": response.estimator,
        "lines": len(response.frequency),
        "from_hz": response.frequency[0],
        "to_hz": response.frequency[-1],
        "rotor_speed": response.rotor_speed,
    }


def _median_relative_sigma(transfer: Transfer, component: str) -> float:
    """Median over the lines of sigma over amplitude, in the best-responding channel, at the highest level."""
    import numpy as np

    from balance_cli.signals.response.transfer import relative_sigma, response_to_component

    return float(np.median(relative_sigma(response_to_component(transfer, component))))


def response_lines(transfer: Transfer) -> Iterator[str]:
    """Yield the lines of the console summary: runs, least coherence and sigma of each component."""
    from balance_cli.signals.response.transfer import least_coherence, response_components

    for response in transfer.responses:
        low, high = response.frequency[0], response.frequency[-1]
        part = transfer.steady_parts.get(response.run)
        steady = f", steady after {part.first} to {part.last} of {part.periods} periods" if part else ""
        yield (
            f"{response.run}: {' '.join(response.components)}, {response.estimator}, "
            f"{len(response.frequency)} lines from {low:.4g} to {high:.4g} Hz{steady}"
        )
    coherence = least_coherence(transfer)
    yield "component  least coherence  relative sigma"
    for name in response_components(transfer):
        yield f"{name:9s} {coherence[name]:16.4f}  {_median_relative_sigma(transfer, name):.2e}"
