"""Tests that need no model of the plate: what the records alone say of channels, levels, rest, spin and mains."""

from __future__ import annotations

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.data_tests.channel_pairs import channel_tests
from balance_cli.diagnosis.data_tests.mains_detection import mains_tests
from balance_cli.diagnosis.data_tests.run_pairs import level_tests, spin_tests
from balance_cli.diagnosis.data_tests.static_pairs import static_tests
from balance_cli.diagnosis.result import ModelFreeTest
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.estimation.measured_spectra import Spectra


def model_free_tests(
    spectra: Spectra, geometry: Geometry, lowest_mode: float, settings: SearchSettings
) -> tuple[ModelFreeTest, ...]:
    """All of them; `lowest_mode` [Hz], well below which a response is a power series in frequency.

    Each row's probability counts the looks that were taken at it, but not the other rows. A test that these runs
    do not allow has no row.
    """
    runs = spectra.lines
    return (
        *channel_tests(runs, geometry, settings),
        *static_tests(runs, spectra.statics, geometry, lowest_mode, settings.data_tests),
        *level_tests(runs, geometry, settings.data_tests),
        *spin_tests(runs, geometry, settings.data_tests),
        *mains_tests(runs, settings.data_tests),
    )
