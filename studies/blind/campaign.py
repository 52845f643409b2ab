"""A whole campaign of a drawn rig: static, zero, sweeps, check and wind runs, written as run files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from studies.blind.excitation import (
    CYCLES_PER_PERIOD,
    PERIODS,
    from_rest,
    multisine,
    rotor,
    sine_sweep,
    stepped,
)
from studies.blind.records import COMPONENTS, Record, Truth, simulate_records, simulate_static, write_run
from studies.blind.rigs import Rig, geometry_content

Array = NDArray[np.float64]
EXCITATIONS = ("multisine", "multisine", "multisine-several", "random", "sine-sweep", "stepped")
REVOLUTIONS = 150
# The second sweep of a moment about x or y is made with the hub turning, without blades: what spins shows nowhere else.
SPINNING = (3, 4)
# Of an rms of a channel in the strongest record, per sample: 12 to 14 bits of a full range.
NOISE_RANGE = (1e-4, 6e-4)


@dataclass(frozen=True)
class Size:
    """Band of the sweeps [Hz], amplitude of each component and noise of a campaign."""

    band: tuple[float, float]
    level: Array
    noise: float


def draw_size(rig: Rig, rng: np.random.Generator) -> Size:
    """Levels of about 2 % of the weight."""
    force = 0.02 * rig.mass * 9.81
    level = force * np.array([1, 1, 2, rig.radius, rig.radius, 0.8 * rig.radius])
    noise = float(np.exp(rng.uniform(*np.log(NOISE_RANGE))))
    band = (0.12 * rig.modes[0], max(1.2 * rig.modes[-1], 8.6 * rig.rotor_speed))
    return Size(band, level, noise)


def sweeps(rig: Rig, size: Size, excitation: str, rng: np.random.Generator) -> list[Record]:
    """Sweeps of each component at two levels, or of pairs of components with two sets of phases.

    The second sweeps of pitch and roll moment turn the rotor.
    """
    rate = rig.sample_rate
    period = round(CYCLES_PER_PERIOD / rig.modes[0] * rate) / rate
    duration = PERIODS * period
    kind = excitation.split("-several", maxsplit=1)[0]
    pairs = [(0, 4), (1, 3), (2, 5)] if "several" in excitation else [(i,) for i in range(6)]
    records = []
    for excited in pairs:
        signs = ([1, 1], [1, -1]) if len(excited) > 1 else ([1], [0.4])
        waves = [_waveform(kind, period, duration, size.band, rng) for _ in excited]
        for number, sign in enumerate(signs):
            scale = np.zeros(6)
            scale[list(excited)] = np.array(sign) * size.level[list(excited)]
            records.append(_sweep(rig, kind, excited, scale, waves, number, period, duration, rng))
    return records


def _waveform(kind, period, duration, band, rng):  # type: ignore[no-untyped-def]
    if kind == "multisine":
        return multisine(period, band, rng)
    if kind == "random":
        return multisine(2 * duration, band, rng)
    if kind == "sine-sweep":
        return sine_sweep(period, band, rng)
    return stepped(duration, band, 36)


def _sweep(rig, kind, excited, scale, waves, number, period, duration, rng):  # type: ignore[no-untyped-def]
    names = [COMPONENTS[i] for i in excited]
    speed = rig.rotor_speed if number and set(SPINNING) & set(excited) else 0.0
    # Half of the campaigns begin at rest; a stepped record always does.
    rest = rng.random() < 0.5

    def loads(time: Array) -> Array:
        result = np.zeros((len(time), 6))
        for i, wave in zip(excited, waves, strict=True):
            result[:, i] = scale[i] * (from_rest(wave, 0.2 * period)(time) if rest else wave(time))
        return result

    attributes: dict[str, object] = {
        "excitation": kind,
        "excited": names[0] if len(names) == 1 else names,
        "level": float(abs(scale[excited[0]])) if len(names) == 1 else [float(abs(scale[i])) for i in excited],
        "rotor_speed": speed,
    }
    if kind in ("multisine", "sine-sweep"):
        attributes["period"] = period
    name = f"sweep-{'-'.join(names)}-{number + 1}"
    return Record(
        name,
        "sweep",
        duration,
        loads,
        attributes,
        azimuth=(lambda time: 2 * np.pi * speed * time) if speed else None,
        excited=tuple(excited),
        spin=2 * np.pi * speed,
    )


def rotor_records(rig: Rig, size: Size, rng: np.random.Generator) -> tuple[list[Record], dict[str, Array]]:
    """Two check runs and two wind runs, and the true harmonics (n, 6), cosine minus j sine, of the wind runs."""
    records, truths = [], {}
    plan = (("check-1", (0, 2, 4)), ("check-2", (1, 3, 5)), ("wind-1", range(6)), ("wind-2", range(6)))
    for name, excited in plan:
        speed = rig.rotor_speed * rng.uniform(0.97, 1.03)
        duration = np.round((REVOLUTIONS + 0.5) / speed * rig.sample_rate) / rig.sample_rate
        wobble, slow = 0.02 * rng.random(), speed * rng.uniform(0.01, 0.04)
        start = rng.uniform(0, 6.28)

        def azimuth(time, speed=speed, wobble=wobble, slow=slow, start=start):  # type: ignore[no-untyped-def]
            return start + 2 * np.pi * speed * time + wobble * np.sin(2 * np.pi * slow * time)

        used = np.isin(np.arange(6), list(excited))
        n = np.arange(9)[:, None]
        shape = 1 / np.maximum(n, 1) ** 0.7 * np.where((n > 0) & (n % rig.blades == 0), 2.0, 1)
        harmonics = shape * size.level * used * np.exp(1j * rng.uniform(0, 6.28, (9, 6))) * rng.uniform(0.3, 1, (9, 6))
        harmonics[0] = size.level * used * rng.uniform(-3, 3, 6) if name.startswith("wind") else 0
        share = 0.05 if name.startswith("wind") else 0.0
        random = [_scaled(multisine(2 * duration, size.band, rng), share * a) for a in size.level * used]
        kind = name.split("-")[0]
        records.append(
            Record(
                name,
                kind,
                duration,
                rotor(azimuth, harmonics, random),
                {"rotor_speed": speed},
                constant=harmonics[0].real,
                azimuth=azimuth,
                excited=tuple(np.flatnonzero(used)) if kind == "check" else (),
                spin=2 * np.pi * speed,
            )
        )
        if kind == "wind":
            truths[name] = harmonics
    return records, truths


def _scaled(waveform, factor):  # type: ignore[no-untyped-def]
    return lambda time: factor * waveform(time) if factor else np.zeros(len(time))


def zero_record(rig: Rig) -> Record:
    """The wind-off record."""
    duration = np.round(20 / rig.rotor_speed * rig.sample_rate) / rig.sample_rate
    return Record("zero", "zero", duration, lambda time: np.zeros((len(time), 6)), {"rotor_speed": 0.0})


def static_loads(rig: Rig, size: Size, trim: float) -> Array:
    """Loads (m, 6): each component up, down and back through zero beside a constant Fz."""
    steps = np.array([0, 0.5, 1, 0.5, 0, -0.5, -1, -0.5, 0])
    loads = np.concatenate([np.outer(steps, np.eye(6)[i] * 8 * size.level[i]) for i in range(6)])
    return loads + np.array([0, 0, trim * size.level[2], 0, 0, 0])


def write_campaign(truth: Truth, declared: Rig, excitation: str, seed: int, folder: Path) -> dict[str, Array]:
    """Write geometry and run files of a truth; return the true harmonics of the wind runs."""
    rng = np.random.default_rng([seed, 77])
    folder.mkdir(parents=True, exist_ok=True)
    size = draw_size(declared, rng)
    name = f"blind-{seed}"
    content = geometry_content(declared, name)
    (folder / "geometry.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    common = {"rig": name.upper()}
    for run, trim in (("static-bare", 0.0), ("static-trim", 10.0)):
        loads = static_loads(declared, size, trim)
        applied = loads - truth.load_offset * (loads != 0)
        names, volts = simulate_static(truth, applied, 0.3 * size.noise, rng)
        loads = loads * (1 + 2e-5 * rng.normal(size=loads.shape))
        attributes = {**common, "kind": "static", "run": run, "trim": run.split("-")[1]}
        write_run(folder / f"{run}.h5", attributes, names, {"channels": volts, "loads": loads})
    rotating, truths = rotor_records(declared, size, rng)
    records = [zero_record(declared), *sweeps(declared, size, excitation, rng), *rotating]
    runs = simulate_records(truth, records, size.noise, rng)
    channels = [channel.name for channel in declared.channels]
    for record in records:
        made = runs[record.name]
        attributes = {**common, "kind": record.kind, "run": record.name, "sample_rate": declared.sample_rate}
        write_run(folder / f"{record.name}.h5", {**attributes, **made["attributes"]}, channels, made)
    return truths
