"""All tests that need no model of the plate: channels, runs, halves of runs, statics, levels, rotor speed and mains."""

from __future__ import annotations

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.data_tests.channel_drifts import channel_drift_tests
from balance_cli.diagnosis.data_tests.channel_pairs import channel_tests
from balance_cli.diagnosis.data_tests.mains_detection import mains_tests
from balance_cli.diagnosis.data_tests.record_changes import record_tests
from balance_cli.diagnosis.data_tests.run_changes import run_tests
from balance_cli.diagnosis.data_tests.run_pairs import level_tests, spin_tests
from balance_cli.diagnosis.data_tests.static_pairs import static_tests
from balance_cli.diagnosis.result import ModelFreeTest
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.estimation.measured_spectra import Spectra


def model_free_tests(
    spectra: Spectra, geometry: Geometry, lowest_mode: float, settings: SearchSettings
) -> tuple[ModelFreeTest, ...]:
    """The rows of all tests; well below `lowest_mode` [Hz] a response is a power series in frequency.

    The p-value of each row is corrected for the tests within the row, not for the other rows. A test for which the runs
    do not suffice has no row.
    """
    runs = spectra.lines
    return (
        *channel_tests(runs, geometry, settings),
        *static_tests(runs, spectra.statics, geometry, lowest_mode, settings.data_tests),
        *run_tests(runs, geometry, settings.data_tests),
        *record_tests(runs, geometry, settings.data_tests),
        *channel_drift_tests(runs, geometry, settings.data_tests),
        *level_tests(runs, geometry, settings.data_tests),
        *spin_tests(runs, geometry, settings.data_tests),
        *mains_tests(runs, settings.data_tests),
    )
