"""Initial candidates that a turning rotor shows: sweeps at rest and with the rotor turning differ, and no others do.

An effect of what spins acts in few runs. While the model has other errors its score is small beside theirs, and those
runs pull the other effects away from where they belong. The comparison of two runs needs no model.
"""

from __future__ import annotations

from collections.abc import Sequence

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.data_tests.run_pairs import level_tests, spin_tests
from balance_cli.diagnosis.search.candidates import candidates
from balance_cli.diagnosis.search.initial_candidates import InitialCandidates
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.diagnosis.significance import bonferroni_min_p_value
from balance_cli.signals.run_spectrum import RunSpectrum

REASON = "sweeps at rest and with the rotor turning differ"


def spin_candidates(
    runs: Sequence[RunSpectrum], geometry: Geometry, settings: SearchSettings
) -> tuple[InitialCandidates, ...]:
    """Return the effects of what spins, where runs differ by the turning of the rotor alone; none where levels do.

    A response that depends on the level, or drifts from run to run, differs between any two runs.
    """
    spin = spin_tests(runs, geometry, settings.data_tests)
    pool = tuple(item for item in candidates(geometry, excluded=settings.excluded) if item.effect.needs_spin)
    level, limit = settings.data_tests.significance_level, settings.selection.significance_level
    if not pool or not spin or bonferroni_min_p_value([test.p_value for test in spin]) > limit:
        return ()
    if any(test.p_value < level for test in level_tests(runs, geometry, settings.data_tests)):
        return ()
    gain = max(test.chi2 - test.dof for test in spin)
    return (InitialCandidates(pool, gain, REASON, is_certain=False),)
