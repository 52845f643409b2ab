"""Thermocouples of TDMS files: voltages that no temperature makes are missing samples."""

import numpy as np
import pytest

from balance_cli.importers.base import TextLayout
from balance_cli.importers.tdms import open_file


def test_voltages_beyond_the_type_are_missing_samples(tmp_path):
    """The polynomials of npTDMS give -2e10 degC for an open input of type K."""
    nptdms = pytest.importorskip("nptdms")
    microvolts = np.array([0.0, 20644.0, 1e6, -5e4, 54000.0, 6e4, -6000.0])
    scale = {"Scale_Type": "Thermocouple", "Thermocouple_Thermocouple_Type": 10073}
    properties = {f"NI_Scale[0]_{name}": value for name, value in scale.items()}
    properties |= {
        "NI_Number_Of_Scales": 1,
        "NI_Scaling_Status": "unscaled",
        "wf_increment": 0.1,
        "unit_string": "degC",
    }
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as writer:
        writer.write_segment([nptdms.ChannelObject("G", "T1", microvolts, properties)])
    (group,) = open_file(tmp_path / "a.tdms", TextLayout()).groups
    read = group.read([0], 0, len(microvolts))[:, 0]
    np.testing.assert_array_equal(np.isfinite(read), [True, True, False, False, True, False, True])
    np.testing.assert_allclose(read[[0, 1]], [0.0, 500.0], atol=0.1)
