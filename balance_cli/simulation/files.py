"""Files of a simulation: the plan that the user writes, and the truth that accompanies the run files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import ValidationError

from balance_cli.io.atomic import os_errors_as_user_error
from balance_cli.io.errors import UserError
from balance_cli.io.hdf5_output import Hdf5Output
from balance_cli.io.sniff import describe_file, require_file
from balance_cli.io.text_output import write_text
from balance_cli.io.yaml_file import read_yaml
from balance_cli.simulation.extensions.base import Extension
from balance_cli.simulation.plans import CampaignPlan
from balance_cli.simulation.rig import TrueRig
from balance_cli.simulation.truth import RunTruth

TRUTH_FORMAT = "balance-truth/1"


def read_plan(path: Path) -> CampaignPlan:
    """A plan from YAML: the key `runs` with a list of runs, each with `run`, `kind` and its settings.

    Raises UserError where the file cannot be read or holds no plan.
    """
    try:
        require_file(path)
        if not path.is_file():
            raise UserError(f"is {describe_file(path)}, where a plan was expected", remedy="Give a YAML file")
        declared = read_yaml(path, "a plan")
    except UserError as error:
        raise error.with_location(file=str(path)) from error
    try:
        return CampaignPlan.model_validate(declared)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        message = first["msg"].removeprefix("Value error, ")
        if isinstance(first["input"], str | int | float):
            message = f"{message.removeprefix('Input ')} (found {first['input']!r:.60})"
        raise UserError(message, str(path), place, "Correct this entry of the plan") from error


def rig_to_dict(rig: TrueRig) -> dict[str, Any]:
    """The true rig as plain numbers, in SI units."""
    geometry = rig.geometry
    return {
        "mass": rig.mass,
        "centre_of_gravity": rig.cg.tolist(),
        "inertia": rig.inertia.tolist(),
        "stiffness": dict(zip(geometry.cell_names, rig.stiffness.tolist(), strict=True)),
        "damping_ratios": rig.damping_ratios.tolist(),
        "torque": _torque_to_dict(rig),
        "sensitivities": dict(zip(geometry.channel_names, rig.sensitivities.tolist(), strict=True)),
        "effects": [effect_to_dict(effect) for effect in rig.extensions],
    }


def _torque_to_dict(rig: TrueRig) -> dict[str, Any] | None:
    """The only torque meter, several by their names, or None without any."""
    properties = {
        "stiffness": rig.torque_stiffness.tolist(),
        "inertia": rig.torque_inertia.tolist(),
        "damping_ratio": rig.torque_damping_ratio.tolist(),
    }
    meters = [
        (meter.name, {key: value[i] for key, value in properties.items()})
        for i, meter in enumerate(rig.geometry.shaft_meters)
    ]
    if rig.geometry.torque_meter:
        return meters[0][1]
    return {str(name): about for name, about in meters} or None


def effect_to_dict(effect: Extension) -> dict[str, Any]:
    """An effect as a geometry declares it."""
    parameters = asdict(effect)
    return {"name": effect.name, "where": list(parameters.pop("where")), "parameters": parameters}


def write_truth_text(path: Path, rig: TrueRig, about: Mapping[str, Any], plan: CampaignPlan) -> None:
    """Write the true rig, the plan and further facts `about` the simulation as YAML."""
    content = {
        "format": TRUTH_FORMAT,
        **about,
        "rig": rig_to_dict(rig),
        "runs": [run.model_dump(mode="json", exclude_none=True) for run in plan.runs],
    }
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
    with os_errors_as_user_error(path):
        write_text(path, text)


def write_truth_arrays(path: Path, truths: Sequence[RunTruth]) -> None:
    """Write the truth of each run as one group, with datasets named as the fields of RunTruth."""
    with Hdf5Output(path) as output:
        output.file.attrs["format"] = TRUTH_FORMAT
        for truth in truths:
            group = output.file.create_group(truth.name)
            group.attrs["kind"] = truth.kind
            for name, value in asdict(truth).items():
                if isinstance(value, np.ndarray):
                    group.create_dataset(name, data=value, compression="gzip", shuffle=True)
