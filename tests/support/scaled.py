"""A campaign in other units: the same volts, with times, forces and lengths multiplied by factors."""

from dataclasses import replace

import numpy as np

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import geometry_from_dict

DIMENSIONS = {
    "kg": (2, 1, -1),
    "kg m2": (2, 1, 1),
    "N": (0, 1, 0),
    "N m": (0, 1, 1),
    "N/m": (0, 1, -1),
    "N/m2": (0, 1, -2),
    "N/m3": (0, 1, -3),
    "N s/m": (1, 1, -1),
    "N s2/m2": (2, 1, -2),
    "m/s": (-1, 0, 1),
    "N m/rad": (0, 1, 1),
    "m": (0, 0, 1),
    "1/m": (0, 0, -1),
    "m/N": (0, -1, 1),
    "rad/(N m)": (0, -1, -1),
    "s": (1, 0, 0),
    "Hz": (-1, 0, 0),
    "V/N": (0, -1, 0),
    "V/(N m)": (0, -1, -1),
    "V": (0, 0, 0),
    "1": (0, 0, 0),
    "rad": (0, 0, 0),
}
"""Exponents of time, force and length of a unit; volts stay."""


class Scale:
    """Factors of time, force and length."""

    def __init__(self, time: float, force: float, length: float) -> None:
        self.factors = np.array([time, force, length], float)

    def of(self, unit: str) -> float:
        """The factor of a quantity in this unit."""
        return float(np.prod(self.factors ** np.array(DIMENSIONS[unit])))

    def geometry(self, geometry: Geometry) -> Geometry:
        """The geometry of the same rig in other units."""
        content = geometry.model_dump(mode="json", exclude_none=True)
        content["hub"] = self._scaled(content["hub"], "m")
        for body in content["bodies"]:
            body.update(mass=self._scaled(body["mass"], "kg"), position=self._scaled(body["position"], "m"))
            body["inertia"] = {name: self._scaled(value, "kg m2") for name, value in body["inertia"].items()}
        for cell in content["cells"]:
            cell["position"], cell["full_range"] = (
                self._scaled(cell["position"], "m"),
                self._scaled(cell["full_range"], "N"),
            )
            for name in {"stiffness", "series"} & set(cell):
                cell[name] = self._scaled(cell[name], "N/m")
        if "torque_meter" in content:
            meter = content["torque_meter"]
            meter.update(
                stiffness=self._scaled(meter["stiffness"], "N m/rad"), inertia=self._scaled(meter["inertia"], "kg m2")
            )
        for channel in content["channels"]:
            channel["sensitivity"] *= self.of("V/(N m)" if channel.get("torque_meter") else "V/N")
            for name, unit in (("lowpass", "Hz"), ("time_constant", "s")):
                if name in channel:
                    channel[name] *= self.of(unit)
        if "filter" in content.get("acquisition", {}):
            content["acquisition"]["filter"]["cutoff"] *= self.of("Hz")
        content["tolerances"]["centre_of_gravity"] *= self.of("m")
        if "rotor" in content:
            content["rotor"]["speed"] *= self.of("Hz")
        return geometry_from_dict(content)

    def run(self, run):
        """The same record in other units."""
        block = run.read()
        loads = block.loads * np.repeat([self.of("N"), self.of("N m")], 3)
        timing = {}
        if run.kind != "static":
            units = ["N" if name.startswith("F") else "N m" for name in run.excited]
            timing = {
                "sample_rate": run.sample_rate * self.of("Hz"),
                "rotor_speed": run.rotor_speed * self.of("Hz"),
                "level": tuple(level * self.of(unit) for level, unit in zip(run.level, units, strict=True)),
                "period": None if run.period is None else run.period * self.of("s"),
            }
        return replace(run, source=MemorySource(block.channels, loads), **timing)

    def _scaled(self, value, unit):
        return [self._scaled(item, unit) for item in value] if isinstance(value, list) else value * self.of(unit)
