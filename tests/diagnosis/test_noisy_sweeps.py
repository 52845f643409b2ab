"""Lines of a sweep at which the channels show nothing but noise do not contradict the computed response."""

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import StateSpace, lsim

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.diagnosis.consistency.campaign import campaign_findings

ONE_DOF = load_geometry(Path(__file__).parents[2] / "configs" / "one-dof.yaml")
RATE, SECONDS, MASS, STIFFNESS = 2000.0, 25.0, 25.0, 4.0e5


def drifting_noise(samples: int) -> np.ndarray:
    """Noise of unit size whose density falls with the frequency, as that of amplifiers does."""
    rng = np.random.default_rng(4)
    frequency = np.fft.rfftfreq(samples, 1 / RATE)
    spectrum = np.exp(2j * np.pi * rng.random(len(frequency))) / np.sqrt(np.maximum(frequency, frequency[1]))
    noise = np.fft.irfft(spectrum, samples)
    return np.asarray(noise / noise.std())


def hammered(noise: float, stiffness: float = STIFFNESS) -> Run:
    """The bench, with a tap of 4 ms every 2.5 s and `noise` [N] in its cell."""
    time = np.arange(int(SECONDS * RATE)) / RATE
    phase = (time - 0.7) % 2.5
    force = np.where((phase < 4e-3) & (time > 0.6), 200.0 * np.sin(np.pi * phase / 4e-3) ** 2, 0.0)
    damping = 2 * 0.01 * np.sqrt(stiffness * MASS)
    state = [[0.0, 1.0], [-stiffness / MASS, -damping / MASS]], [[0.0], [1 / MASS]], [[stiffness, 0.0]], [[0.0]]
    reading = 0.01 * (lsim(StateSpace(*state), force, time)[1] + noise * drifting_noise(len(time)))
    loads = np.zeros((len(time), 6))
    loads[:, 2] = force
    source = MemorySource(reading[:, None], loads)
    head = ("sweep-Fz", "BENCH-1", "sweep", ("z.strain",), len(time), source, True, RATE)
    return Run(*head, excited=("Fz",), excitation="impact", level=(float(force.std()),))


def test_a_hammer_record_whose_high_and_low_lines_are_noise_agrees() -> None:
    """It had the warning that computed and measured responses differ by a factor."""
    assert campaign_findings(ONE_DOF, (hammered(0.3),)) == ()


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_wrong_stiffness_is_found_beside_noise(noise: float) -> None:
    (finding,) = campaign_findings(ONE_DOF, (hammered(noise, stiffness=30 * STIFFNESS),))
    assert "stiffness" in finding.text
