"""Parts of the JSON summaries that several commands share: modes, parameters, effects (docs/json.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from balance_cli.diagnosis.result import FoundEffect
    from balance_cli.estimation.identified_model import IdentifiedModel, ModeTable, ParameterTable
    from balance_cli.model.fitted_effects import FittedEffect


def modes_summary(modes: ModeTable) -> list[dict[str, float]]:
    """Return the modes as a list of objects."""
    names = ("frequency_hz", "damping_ratio", "sigma_frequency_hz", "sigma_damping_ratio")
    columns = (modes.frequency, modes.damping_ratio, modes.sigma_frequency, modes.sigma_damping_ratio)
    return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]


def parameters_summary(table: ParameterTable) -> dict[str, dict[str, Any]]:
    """Return the parameters by name."""
    rows = zip(table.names, table.value, table.sigma, table.units, table.informed_by, strict=True)
    return {name: dict(zip(("value", "sigma", "unit", "rests_on"), entry, strict=True)) for name, *entry in rows}


def declared_summary(model: IdentifiedModel) -> list[dict[str, Any]]:
    """Return the parameters that depart from their declared tolerances, largest departure first."""
    from balance_cli.estimation.declared_departures import declared_agreement

    return [
        {"name": item.name, "declared": item.declared, "found": item.found, "sigmas": item.sigmas, "unit": item.unit}
        for item in declared_agreement(model).departures
    ]


def effect_summary(effect: FittedEffect | FoundEffect) -> dict[str, Any]:
    """Return an effect as an object with its name, places and parameters; a parameter that is a word has no sigma."""
    parameters: dict[str, dict[str, Any]] = {
        item.name: {"value": item.value, "sigma": item.sigma, "unit": item.unit}
        | ({} if item.interval is None else {"interval_95": item.interval})
        for item in effect.parameters
    }
    if effect.choice:
        name, word = effect.choice
        parameters[name] = {"value": word, "sigma": None, "unit": ""}
    return {"name": effect.name, "where": effect.where, "parameters": parameters}
