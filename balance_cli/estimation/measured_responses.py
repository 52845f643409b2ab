"""Measured frequency responses among the runs of a fit: which may be used, and their lines as those of sweeps.

A response holds what a sweep says of a linear balance, and nothing of what is no response: samples, means, transients,
levels within a record. Effects that show only there cannot be fitted to it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.io.errors import UserError
from balance_cli.model.effects import EFFECTS
from balance_cli.signals.response.choices import AVERAGED_ESTIMATORS, IMPORTED, PERIODIC
from balance_cli.signals.response.fitted_lines import spectrum_of_response
from balance_cli.signals.response.transfer import Transfer

RUN_ROLES = ("run", "responses")
"""Roles of the inputs from which responses were made, by `sweep-tf` and by `import-frf`."""
NO_SAMPLES = "frequency responses hold no samples: it needs the records"
"""Why an effect cannot be seen in measured responses."""


@dataclass(frozen=True)
class MeasuredResponses:
    """The responses of one file, and the digests of the `sources` that they were made from, where these are known."""

    transfer: Transfer
    file: str = ""
    sources: frozenset[str] = frozenset()

    @property
    def runs(self) -> frozenset[str]:
        """The names of the runs, or references of a map, that the responses were made from."""
        return frozenset(name for response in self.transfer.responses for name in response.run.split("+"))


def require_usable_responses(items: Sequence[MeasuredResponses], runs: Sequence[Run], geometry: Geometry) -> None:
    """Raise UserError for responses of another rig, of unknown noise, or of data that others of the files hold, too."""
    for number, item in enumerate(items):
        _require_same_rig(item, geometry)
        for run in runs:
            if run.kind == "sweep" and (run.name in item.runs or run.digest in item.sources):
                raise _counted_twice(item, f"run {run.name}", run.file)
        for other in items[:number]:
            shared = sorted(item.runs & other.runs)
            if shared and (item.sources & other.sources or not item.sources):
                raise _counted_twice(item, ", ".join(shared), other.file)
        _require_linear(geometry, item)


def _require_same_rig(item: MeasuredResponses, geometry: Geometry) -> None:
    own = item.transfer.geometry
    if own.rig != geometry.rig:
        fault = f"is of rig `{own.rig}`, but the geometry `{geometry.name}` is of rig `{geometry.rig}`"
        raise UserError(fault, item.file, "rig", "Give the geometry of that rig, or responses of this one")
    measured = {name for response in item.transfer.responses for name in response.channel_names}
    unknown = sorted(measured - set(geometry.channel_names))
    if unknown:
        fault = f"holds the channel `{unknown[0]}`, which the geometry `{geometry.name}` does not declare"
        raise UserError(fault, item.file, "channels", f"It declares {', '.join(geometry.channel_names)}")
    if own.hub != geometry.hub:
        fault = f"holds responses to loads at the hub {list(own.hub)}, the geometry has it at {list(geometry.hub)}"
        raise UserError(fault, item.file, "hub", "Make the responses again with this geometry")
    if item.transfer.estimator == IMPORTED:
        _require_same_sensitivities(item, measured, geometry)


def _require_same_sensitivities(item: MeasuredResponses, measured: set[str], geometry: Geometry) -> None:
    """Raise UserError where responses that may have been converted by a sensitivity meet another one."""
    own = {channel.name: channel.sensitivity for channel in item.transfer.geometry.channels}
    for channel in geometry.channels:
        if channel.name in measured and channel.sensitivity != own[channel.name]:
            fault = f"was imported with a sensitivity of {channel.name} of {own[channel.name]:g}"
            remedy = f"Import it again with this geometry, which has {channel.sensitivity:g}"
            raise UserError(fault, item.file, "channels", remedy)


def _counted_twice(item: MeasuredResponses, names: str, file: str) -> UserError:
    fault = f"holds the data of {names} a second time ({file or 'it is among the runs'})"
    return UserError(fault, item.file, "responses", "Give the runs, or the responses made from them")


def _require_linear(geometry: Geometry, item: MeasuredResponses) -> None:
    """Raise UserError where an effect of the geometry cannot be fitted to responses."""
    for effect in geometry.effects:
        if effect.name in effects_of_samples():
            remedy = "Leave the effect out, or give the runs in place of the responses"
            raise UserError(f"`{effect.name}` cannot be fitted: {NO_SAMPLES}", item.file, "effects", remedy)


def require_independent_lines(items: Sequence[MeasuredResponses]) -> None:
    """Raise UserError for responses whose errors are smooth over frequency, which a diagnosis takes for effects.

    Of six campaigns without a fault, two had a crosstalk of 5 sigma by local models. Their runs are there to be given.
    """
    for item in items:
        for response in item.transfer.responses:
            if response.estimator not in (PERIODIC, IMPORTED):
                fault = f"response {response.run} was estimated by `{response.estimator}`: its errors are smooth over"
                remedy = "Give the runs that it was made from"
                raise UserError(f"{fault} frequency, and pass for effects", item.file, "responses", remedy)


def effects_of_samples() -> tuple[str, ...]:
    """Return the names of the effects that show only in samples: nonlinear ones, means, and tones of the mains."""
    return tuple(effect.name for effect in EFFECTS if effect.needs_mean)


def add_responses(spectra: Spectra, items: Sequence[MeasuredResponses]) -> Spectra:
    """Return the spectra with the lines of the responses, each under the name of its runs.

    Raises UserError for responses whose noise is not known.
    """
    names = {run.run for run in spectra.lines}
    lines, left_out, responses = list(spectra.lines), dict(spectra.channels_left_out), list(spectra.responses)
    for item in items:
        for response in item.transfer.responses:
            name = _unused_name(response.run, item.file, names)
            names.add(name)
            responses.append(name)
            try:
                lines.append(replace(spectrum_of_response(response), run=name))
            except UserError as error:
                raise error.with_location(file=item.file) from error
        left_out |= item.transfer.channels_left_out
    return replace(spectra, lines=tuple(lines), channels_left_out=left_out, responses=tuple(responses))


def _unused_name(name: str, file: str, used: set[str]) -> str:
    """Return the name of a response, with that of its file where another one has it."""
    if name not in used:
        return name
    named = f"{name} of {file or 'other responses'}"
    return named if named not in used else f"{named} ({len(used)})"


def response_warnings(items: Sequence[MeasuredResponses]) -> Iterator[str]:
    """Yield what is to be known of a fit to these responses: what their sigma does not contain, in words."""
    for item in items:
        estimators = {response.estimator for response in item.transfer.responses}
        averaged = sorted(estimators & set(AVERAGED_ESTIMATORS))
        if averaged:
            yield (
                f"{item.file}: leakage of the estimator {averaged[0]} is not in the sigma of its responses, "
                "nor in that of the model: use the default estimator of `sweep-tf`"
            )
        if IMPORTED in estimators:
            yield (
                f"{item.file}: errors of imported responses count as independent between channels and references: "
                "with noise of the forces, or references driven at once, sigma is too small"
            )
