"""Wind runs with more noise than the sweeps: their loads are untested, not contradicted; less noise contradicts."""

import pytest

from balance_cli.diagnosis.consistency.findings import NOISE_LEVEL, WARNING, ConsistencyFinding
from balance_cli.reduction.flags import MODEL_CONTRADICTED, UNTESTED
from balance_cli.steps.contradicted_loads import flag_contradicted_runs
from tests.support.report_content import loads as hub_loads


@pytest.mark.parametrize(
    ("factor", "flag"), [(2.0, UNTESTED), (8.0, UNTESTED), (1e3, MODEL_CONTRADICTED), (0.5, MODEL_CONTRADICTED)]
)
def test_noise_of_drive_or_flow_leaves_a_factor_of_all_channels_untested(factor, flag):
    """Right loads of runs with 2 to 8 times the noise were all `model contradicted`, as if the response were wrong."""
    loads = hub_loads().runs
    name = next(iter(loads))
    finding = ConsistencyFinding(NOISE_LEVEL, WARNING, "all channels have another noise", (name,), factor=factor)
    flagged = flag_contradicted_runs(loads, [finding])[name]
    other = ({UNTESTED, MODEL_CONTRADICTED} - {flag}).pop()
    assert all(flag in words for row in flagged.flags for words in row)
    assert [other in words for row in flagged.flags for words in row] == [
        other in words for row in loads[name].flags for words in row
    ]
    assert finding.sentence in flagged.notes
