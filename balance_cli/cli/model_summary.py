"""Parts of a model as summaries for scripts have them: modes, parameters, effects."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from balance_cli.diagnosis.result import FoundEffect
    from balance_cli.estimation.identified_model import ModeTable, ParameterTable
    from balance_cli.model.fitted_effects import FittedEffect


def modes_summary(modes: ModeTable) -> list[dict[str, float]]:
    """The modes as a list of the keys of the contract."""
    names = ("frequency_hz", "damping_ratio", "sigma_frequency_hz", "sigma_damping_ratio")
    columns = (modes.frequency, modes.damping_ratio, modes.sigma_frequency, modes.sigma_damping_ratio)
    return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]


def parameters_summary(table: ParameterTable) -> dict[str, dict[str, Any]]:
    """Every parameter by its name."""
    rows = zip(table.names, table.value, table.sigma, table.units, table.informed_by, strict=True)
    return {name: dict(zip(("value", "sigma", "unit", "rests_on"), entry, strict=True)) for name, *entry in rows}


def effect_summary(effect: FittedEffect | FoundEffect) -> dict[str, Any]:
    """An effect as the contract's section on effects has it; a parameter that is a word has no sigma."""
    parameters: dict[str, dict[str, Any]] = {
        item.name: {"value": item.value, "sigma": item.sigma, "unit": item.unit}
        | ({} if item.interval is None else {"interval_95": item.interval})
        for item in effect.parameters
    }
    if effect.choice:
        name, word = effect.choice
        parameters[name] = {"value": word, "sigma": None, "unit": ""}
    return {"name": effect.name, "where": effect.where, "parameters": parameters}
