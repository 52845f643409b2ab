"""Tables of the study of attribution."""

from __future__ import annotations

import numpy as np
import pandas as pd

Z_95 = 1.959963984540054
# Of the error that a model's own error makes, less is no change: what the noise of the check run leaves.
SAME_ERROR = 1.02


def attribution_table(rows: pd.DataFrame) -> pd.DataFrame:
    """One line for each hidden effect, and one for each kind of campaign.

    `possible`: share that a test with this many candidates at this level could detect at all; `right`: of all
    campaigns; `right_of_detected`: of those in which something was found. Load errors are medians of the largest
    component's error on the run held out; `not_worse`: share in which closing did not raise it.
    """
    rows = rows.assign(effect=rows["hidden"].where(rows["kind"] == "nothing", rows["hidden"].map(_name)))
    for kind, effect in (("pair", "two effects"), ("large", "one large effect"), ("three", "three effects")):
        rows.loc[rows["kind"] == kind, "effect"] = effect
    groups = [(key, part) for key, part in rows.groupby(["kind", "effect"], sort=False)]
    lines = [_line(kind, effect, part) for (kind, effect), part in groups]
    singles = rows[rows["kind"] == "single"]
    if len(singles):
        lines.append(_line("single", "all single effects", singles))
        lines += [_line("single", f"all, {name}", part) for name, part in singles.groupby("excitation", sort=True)]
    return pd.DataFrame(lines)


def _name(label: str) -> str:
    return label.partition("@")[0]


def _line(kind: str, effect: str, part: pd.DataFrame) -> dict[str, object]:
    found = part[part["detected"]]
    z = np.array([float(z) for text in part["deviations"].dropna().astype(str) for z in text.split()])
    raised = part["load_error_after"] > SAME_ERROR * part["load_error_before"]
    return {
        "kind": kind,
        "effect": effect,
        "campaigns": len(part),
        "possible": part["possible"].mean(),
        "detected": part["detected"].mean(),
        "right": part["right"].mean(),
        "right_of_detected": found["right"].mean() if len(found) else np.nan,
        "mean_set_size": part["set_size"].mean(),
        "right_by_set_only": (part["right"] & part["by_set"]).mean(),
        "parameters": len(z),
        "coverage_95": float(np.mean(np.abs(z) < Z_95)) if len(z) else np.nan,
        "chi2_before": part["chi2_before"].median(),
        "chi2_after": part["chi2_after"].median(),
        "load_error_before": part["load_error_before"].median(),
        "load_error_after": part["load_error_after"].median(),
        "load_error_noise": part["load_error_noise"].median(),
        "not_worse": 1.0 - raised.mean(),
    }
