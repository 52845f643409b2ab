"""Records whose loads change within them, on rigs, rates and speeds that have little in common: which rows are flagged.

A record is made in the frequency domain from the responses of the declared rig: harmonics of the rotor, gusts, noise,
and a change of one load in time. So the loads at each moment are known, and no simulation in time is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.system_response import response, solve
from balance_cli.reduction.flags import MODEL_CONTRADICTED, NOT_STEADY, REDUNDANCY
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.simulation import CampaignPlan, Noise, simulate_campaign, true_rig
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce import reduce_run
from tests.support.other_rigs import RIGS, other_rig, short_campaign

Array = NDArray[np.float64]

RATES = {"A": (2048.0, 12800.0), "B": (4096.0, 25600.0), "C": (512.0, 1024.0), "D": (1000.0, 51200.0)}
RATES["E"] = (25600.0, 51200.0)
SPEEDS = (4.0, 40.0)
"""[Hz], between which the speed of a rotor is drawn; on the slow rig C up to a fifth of it."""
REVOLUTIONS = (12, 25, 100)
MOST_SAMPLES = 20_000
"""Of a record: a long one at a high rate has fewer revolutions."""
SIZES = {"A": 20.0, "B": 40.0, "C": 200.0, "D": 40.0, "E": 20.0}
"""Amplitude of 1/rev and mean [N] of Fz."""
NOISE_SHARE = 3e-3
"""Noise of a channel over its rms."""
TURBULENCE_SHARES = (0.0, 0.05)
"""Rms of random loads over the amplitude of 1/rev."""

Profile = Callable[[Array], Array]
CHANGES: dict[str, Profile] = {
    "none": lambda x: np.zeros_like(x),
    "step of 20 %": lambda x: 0.2 * (x > 0.55),
    "ramp of 30 %": lambda x: 0.3 * x,
    "sine of 15 %, one period": lambda x: 0.15 * np.sin(2 * np.pi * x + 0.5),
    "sine of 25 %, two periods": lambda x: 0.25 * np.sin(4 * np.pi * x + 0.5),
    "burst of 60 % for a sixth": lambda x: 0.6 * ((x > 0.4) & (x < 0.4 + 1 / 6)),
    "1/rev doubled at 60 %": lambda x: 1.0 * (x > 0.6),
}
"""Change of a load over its mean (of 1/rev over its amplitude), by the share of the record that has passed."""
OF_HARMONIC = "1/rev doubled at 60 %"


@dataclass(frozen=True)
class Bench:
    """A rig with its calibration and its exact model."""

    letter: str
    geometry: Geometry
    calibration: Calibration
    source: ModelSource


def bench(letter: str) -> Bench:
    """Return a rig calibrated with its static runs."""
    geometry = other_rig(letter)
    statics = [plan for plan in short_campaign(letter).runs if plan.kind == "static"]
    runs = simulate_campaign(true_rig(geometry), CampaignPlan(runs=tuple(statics)), Noise(), 1).runs
    model = identify(Spectra((), (), (), {}), geometry, IdentifyOptions(method="computed"))
    return Bench(letter, geometry, calibrate(runs, geometry), ModelSource(model))


def changing_record(rig: Bench, change: str, revolutions: int, rate: float, seed: int) -> Run:
    """Return a wind record of a rig in which Fz changes as named, from the first sample on in its steady state."""
    rng = np.random.default_rng(seed)
    fastest = SPEEDS[1] / (5.0 if rig.letter == "C" else 1.0)
    speed = float(np.exp(rng.uniform(np.log(SPEEDS[0]), np.log(fastest))))
    revolutions = max(REVOLUTIONS[0], min(revolutions, int(MOST_SAMPLES * speed / rate)))
    count = int((revolutions + 0.4) * rate / speed)
    padded = 2 * count
    time = np.arange(padded) / rate
    # The transform is periodic: it holds whole revolutions, and the change returns to its beginning. A jump would begin
    # a transient in what is to be steady from the first sample on.
    speed = round(padded * speed / rate) * rate / padded
    shape = CHANGES[change](np.minimum(time * rate / count, 1.0))
    shape[count:] = np.linspace(shape[count - 1], shape[0], padded - count)
    size = SIZES[rig.letter]
    angle = 2 * np.pi * (speed * time + rng.random())
    loads = np.zeros((padded, 6))
    for j in range(6):
        arm = 1.0 if j < 3 else 0.1
        for n in range(1, 5):
            growth = 1.0 + shape if (j == 2 and n == 1 and change == OF_HARMONIC) else 1.0
            loads[:, j] += growth * arm * size / n * np.cos(n * angle + rng.uniform(0, 2 * np.pi))
    mean = 5.0 * size
    loads[:, 2] += mean * (1.0 + (0.0 if change == OF_HARMONIC else shape))
    turbulence = (
        rng.choice(TURBULENCE_SHARES) * size * rng.standard_normal((padded, 6)) * np.where(np.arange(6) < 3, 1.0, 0.1)
    )
    channels = _read(rig, loads + turbulence, rate, speed)[:count]
    noise = NOISE_SHARE * channels.std(axis=0) * rng.standard_normal(channels.shape)
    first = (-angle[0] % (2 * np.pi)) / (2 * np.pi * speed)
    pulses = first + np.arange(int(np.floor((count / rate - first) * speed)) + 1) / speed
    name = f"{change}-{seed}"
    return Run(
        name=name,
        rig=rig.geometry.rig,
        kind="wind",
        channel_names=rig.geometry.channel_names,
        samples=count,
        source=MemorySource(channels + noise, None),
        has_loads=False,
        sample_rate=rate,
        rotor_speed=speed,
        pulse_times=pulses[pulses < count / rate],
    )


def _read(rig: Bench, loads: Array, rate: float, speed: float) -> Array:
    """Return the volts (n, c) that loads (n, 6), repeated for ever, make."""
    frequency = np.fft.rfftfreq(len(loads), 1.0 / rate)
    system = balance_model(rig.geometry).system()
    spectrum = np.fft.rfft(loads, axis=0)
    volts = np.zeros((len(frequency), len(rig.geometry.channel_names)), complex)
    for start in range(0, len(frequency), 20_000):
        part = slice(start, start + 20_000)
        volts[part] = np.einsum("kcj,kj->kc", response(system, solve(system, frequency[part], speed)), spectrum[part])
    volts *= anti_alias_response(rig.geometry.acquisition, frequency)[:, None]
    return np.fft.irfft(volts, len(loads), axis=0)


def steadiness_chunk(seed: int) -> pd.DataFrame:
    """Return one row for each record of a rig: the changes, at one rate, in records of all lengths."""
    return pd.DataFrame(_rows(bench(RIGS[seed % len(RIGS)]), seed))


def _rows(rig: Bench, seed: int) -> Iterator[dict[str, object]]:
    rate = RATES[rig.letter][seed // len(RIGS) % 2]
    for number, (change, revolutions) in enumerate((c, n) for c in CHANGES for n in REVOLUTIONS):
        run = changing_record(rig, change, revolutions, rate, 1000 * seed + number)
        row = {"rig": rig.letter, "rate": rate, "speed": run.rotor_speed, "change": change, "asked": revolutions}
        try:
            loads = reduce_run(run, rig.geometry, rig.calibration, rig.source)
        except UserError as error:
            yield {**row, "refused": str(error)}
            continue
        place = (1 if change == OF_HARMONIC else 0, loads.components.index("Fz"))
        words = np.array([[NOT_STEADY in word for word in flags] for flags in loads.flags])
        others = [w for flags in loads.flags for w in flags if REDUNDANCY in w or MODEL_CONTRADICTED in w]
        yield {
            **row,
            "revolutions": int(run.samples * run.rotor_speed / rate),
            "flagged": bool(words[place]),
            "rows": words.size,
            "rows not steady": int(words.sum()),
            "other flags": len(others),
        }


def steadiness_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return, by change and length, the records, the share with the changed load flagged, and rows flagged at all."""
    kept = rows[rows["flagged"].notna()]
    grouped = kept.assign(flagged=kept["flagged"].astype(float)).groupby(["change", "asked"], sort=False)
    table = grouped.agg({"flagged": ["size", "mean"], "rows": "sum", "rows not steady": "sum", "other flags": "sum"})
    table.columns = ["records", "changed load flagged", "rows", "rows not steady", "other flags"]
    return table.reset_index().rename(columns={"asked": "revolutions"})
