"""The forecast that a plan keeps in its file, and with which the page shows it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from balance_cli.campaign.rig.declared_values import FrozenModel
from balance_cli.io.errors import UserError
from balance_cli.io.formats import HALL_FORMAT, PLAN_FORMAT
from balance_cli.io.result_view import plural
from balance_cli.io.sniff import sniff_format

if TYPE_CHECKING:  # a page without a plan does without the simulation
    from balance_cli.simulation.plans import CampaignPlan


class StoredLevel(FrozenModel):
    """The largest rms `level` [N, N m] of a component, and what limits it."""

    component: str
    level: float
    reason: str


class StoredPlace(FrozenModel):
    """A place of an effect and its smallest size there."""

    place: str
    size: float | None


class StoredEffect(FrozenModel):
    """An effect: its smallest size `before` and after each run, and what it does to the hub loads while not found."""

    name: str
    hardest: str
    parameter: str
    unit: str
    before: float | None
    after: tuple[float | None, ...]
    easiest: StoredPlace
    load_error: Mapping[str, float] | None
    load_share: float | None
    load_shares: tuple[float | None, ...]
    not_shown: tuple[str, ...]
    shown_by: str = ""


class StoredPair(FrozenModel):
    """Two effects that the runs cannot tell apart."""

    first: str
    second: str
    places: int
    cosine: float
    run: str
    cosine_with_run: float
    further: str = ""
    cosine_with_further: float = 1.0
    otherwise: str = ""


class StoredRanking(FrozenModel):
    """What a run adds by itself."""

    run: str
    minutes: float
    worth: float
    load_ratio: float | None


class StoredLoads(FrozenModel):
    """Sigma of the hub loads {component: by harmonic}; after each run {component: by run, by harmonic}."""

    frequency_hz: tuple[float, ...]
    reference: Mapping[str, float]
    sigma_before: Mapping[str, tuple[float, ...]]
    sigma_after: Mapping[str, tuple[float, ...]]
    sigma_after_run: Mapping[str, tuple[tuple[float, ...], ...]]
    sigma_noise: Mapping[str, tuple[float, ...]]
    parameter_part_after_run: tuple[float, ...]


class StoredForecast(FrozenModel):
    """What a plan expects, with the keys of its JSON summary."""

    minutes: float
    complete: bool = True
    made: tuple[str, ...]
    noise: str
    level: float
    power: float
    levels: tuple[StoredLevel, ...]
    effects: tuple[StoredEffect, ...]
    not_predicted: tuple[Mapping[str, str], ...]
    confusion: tuple[StoredPair, ...]
    ranking: tuple[StoredRanking, ...]
    loads: StoredLoads | None


FORECAST_KEYS = tuple(StoredForecast.model_fields)


@dataclass(frozen=True)
class StoredPlan:
    """A plan with its forecast, as read from the `file` of this name."""

    file: str
    plan: CampaignPlan
    forecast: StoredForecast


def read_stored_plan(path: Path) -> StoredPlan:
    """The plan that `balance plan` wrote. Raises UserError where it is not one, or without a forecast."""
    from balance_cli.simulation.files import read_plan

    plan = read_plan(path)
    if plan.format != PLAN_FORMAT or plan.forecast is None:
        raise UserError("holds no forecast", str(path), "forecast", "Give a plan that `balance plan -o` has written")
    return StoredPlan(path.name, plan, _forecast(plan.forecast, path))


def describe_plan_or_hall(path: Path) -> str:
    """What a plan or the file of a hall holds, in some words. Raises UserError for the first fault of the file."""
    from balance_cli.planning.hall_file import load_hall
    from balance_cli.simulation.files import read_plan

    if sniff_format(path) == HALL_FORMAT:
        exciters = load_hall(path).exciters
        return f"test hall with {'exciters of any force' if exciters is None else plural(len(exciters), 'exciter')}"
    plan = read_plan(path)
    if plan.forecast is None:
        return f"plan of {plural(len(plan.runs), 'run')}"
    return f"plan of {plural(len(plan.runs), 'run')}, {read_stored_plan(path).forecast.minutes:.0f} minutes"


def _forecast(declared: Mapping[str, Any], path: Path) -> StoredForecast:
    try:
        return StoredForecast.model_validate(declared)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(["forecast", *(str(part) for part in first["loc"])])
        raise UserError(first["msg"], str(path), place, "Write the plan anew with `balance plan`") from error
