"""Wind runs in any number, as fast as they can be written: harmonic loads through the response of a model, and noise.

They are for timing, not for judging estimates. A reduction by the same response finds nothing to doubt in them; by
another one it seeks the mistake in the channels, which takes longer.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.recording.run_file import write_run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.balance import balance_model
from balance_cli.model.system import System
from balance_cli.model.system_response import response, solve
from balance_cli.signals.anti_alias import anti_alias_response

RATE, SPEED = 800.0, 17.5
HARMONICS = np.arange(1, 9)
NOISE = 2e-4
"""[V] rms of a channel."""


def write_wind_runs(
    folder: Path, geometry: Geometry, count: int, duration: float = 30.0, system: System | None = None
) -> list[Path]:
    """Write runs `wind-00000.h5` and so on; each has loads, a rotor speed, a date and an advance ratio of its own.

    The response is that of a system, by default of the rig as declared.
    """
    system = system or balance_model(geometry).system()
    paths = []
    for index in range(count):
        rng = np.random.default_rng(index)
        speed = SPEED * (1.0 + 0.02 * rng.standard_normal())
        time = np.arange(int(duration * RATE)) / RATE
        T = response(system, solve(system, HARMONICS * speed, speed))
        T = T * anti_alias_response(geometry.acquisition, HARMONICS * speed)[:, None, None]
        loads = (rng.standard_normal((8, 6)) + 1j * rng.standard_normal((8, 6))) * [60, 60, 200, 20, 20, 40]
        volts = np.einsum("hcj,hj->hc", T, loads / HARMONICS[:, None])
        turns = np.exp(1j * np.outer(2 * np.pi * speed * time, HARMONICS))
        channels = (turns @ volts).real + NOISE * rng.standard_normal((len(time), volts.shape[1]))
        run = Run(
            name=f"wind-{index:05d}",
            rig=geometry.rig,
            kind="wind",
            channel_names=geometry.channel_names,
            samples=len(time),
            source=MemorySource(channels.astype(np.float32).astype(float), None),
            has_loads=False,
            sample_rate=RATE,
            rotor_speed=SPEED,
            pulse_times=np.arange(0.0, duration - 1.0 / RATE, 1.0 / speed),
            recorded=f"2026-03-{1 + index // 96 % 28:02d}T{index // 4 % 24:02d}:{15 * (index % 4):02d}:00",
        )
        paths.append(folder / f"{run.name}.h5")
        write_run(paths[-1], run)
    return paths
