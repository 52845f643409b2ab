"""Formats of the files that the commands read and write. Imports nothing, so that any module can."""

from __future__ import annotations

GEOMETRY_FORMAT = "balance-geometry/1"
RUN_FORMAT = "balance-run/1"

CALIBRATION_FORMAT = "balance-calibration/1"
TRANSFER_FORMAT = "balance-transfer/1"
MODEL_FORMAT = "balance-model/1"
DIAGNOSIS_FORMAT = "balance-diagnosis/1"
LOADS_FORMAT = "balance-loads/1"
SPECTRA_FORMAT = "balance-spectra/1"
ARTEFACT_FORMATS = (CALIBRATION_FORMAT, TRANSFER_FORMAT, MODEL_FORMAT, DIAGNOSIS_FORMAT, LOADS_FORMAT, SPECTRA_FORMAT)
"""Formats of results with provenance and digest, in the order in which a campaign makes them."""

HISTORY_FORMAT = "balance-history/1"
MATRIX_FORMAT = "balance-matrix/1"
PLAN_FORMAT = "balance-plan/1"
SURVEY_FORMAT = "balance-survey/1"
IMPORT_FORMAT = "balance-import/1"
FRF_MAP_FORMAT = "balance-frf/1"
HALL_FORMAT = "balance-hall/1"
