"""The page of a diagnosis: what it shows of verdict, effects, errors, residual and trials."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from balance_cli.diagnosis.result import EXPLAINED, NOTHING_MISSING, PARTLY_EXPLAINED, UNEXPLAINED, HoldOut, RunErrors
from balance_cli.report.blocks import Details, Table
from balance_cli.report.diagnosis import section
from balance_cli.report.diagnosis_errors import pooled_hold_out_errors
from balance_cli.report.diagnosis_figures import residual_figure
from balance_cli.report.diagnosis_tables import mode_table
from balance_cli.report.page import build_page
from balance_cli.report.sources import Sources, group_sources
from tests.support.diagnosis_content import diagnosis, hold_out, support_effect
from tests.support.page_content import read, row_of, tables, texts
from tests.support.report_content import artefact, campaign, model


def given(*made) -> Sources:
    return group_sources(
        [(Path(f"d{i}.h5"), artefact("balance-diagnosis/1", item, f"{i}" * 64)) for i, item in enumerate(made)]
    )


def test_the_section_stands_on_the_whole_page():
    everything = [
        *campaign(),
        (Path("d.h5"), artefact("balance-diagnosis/1", diagnosis(hold_out=hold_out()), "9" * 64)),
    ]
    made = build_page(group_sources(everything))
    assert list(made.sections)[2] == "diagnosis"
    assert {"hold-out", "residual"} <= set(made.pictures)
    tags = read(made.html)
    assert not tags.open and not tags.outside
    assert max(tags.ids.values()) == 1 and tags.references <= set(tags.ids)
    words = " ".join(tags.text)
    assert "Diagnosis: explained; with the effects found the model describes the data within their noise." in words
    assert "a tap on the support" in words and "gyroscopic-coupling: all runs are at rest" in words


def test_effects_stand_with_evidence_and_what_they_cannot_be_told_from():
    made = section(given(diagnosis()))
    label = "support-flexibility@x,theta"
    row = ["\N{EN DASH}", "+1.23e6", "3", "<1e-99", "3.10e5", "mast-bending@x", "a tap on the support"]
    assert row_of(made, "chi2 without it", label) == [label, *row]
    assert row_of(made, "chi2 without it", "time-delay@z1.piezo")[1] == "31.0 (Fz)"
    assert row_of(made, "sigma", "mass")[:4] == ["mass", "512", "23", "kg"]
    assert row_of(made, "sigma", "compliance_x")[-1] == "1.9e-08 to 2.9e-08"
    assert row_of(made, "sigma", "damping_ratio")[2] == "–"


def test_errors_are_pooled_over_the_runs_and_shaded_where_they_are_noise():
    second = HoldOut(
        RunErrors({"Fz": 0.1}, {"My": 0.5}, 0.2),
        RunErrors({"Fz": 0.0008}, {"My": 0.01}, 0.02),
        RunErrors({"Fz": 0.0005}, {"My": 0.001}, 0.001),
    )
    both = diagnosis(hold_out={**hold_out(), "check-2": second})
    error = pooled_hold_out_errors(both, "after", "load_error")["Fz"]
    assert error.value == pytest.approx(np.sqrt((0.0006**2 + 0.0008**2) / 2))
    made = section(given(both))
    assert row_of(made, "after / noise", "My") == ["My", "1270", "0.31", "0.25", "1.2"]
    table = next(item for item in tables(made) if "after / noise" in [cell.text for cell in item.head[0]])
    marks = {row[0].text: row[2].mark for row in table.rows if len(row) > 1}
    assert "good" in marks["Fz"] and "good" not in marks["check-2"]


def test_trials_that_were_not_refitted_are_shown_on_demand():
    made = section(given(diagnosis()))
    shown = next(block for block in made.blocks if isinstance(block, Table) and block.head[0][0].text == "round")
    assert [row[6].text for row in shown.rows] == ["accepted", "rejected", "accepted", "kept"]
    (hidden,) = (block for block in made.blocks if isinstance(block, Details) and "without a refit" in block.summary)
    assert [row[1].text for row in hidden.blocks[0].rows] == ["channel-gain@x.piezo", "added-mass"]


def test_tests_that_show_nothing_are_shown_on_demand():
    made = section(given(diagnosis()))
    (hidden,) = (
        block
        for block in made.blocks
        if isinstance(block, Details) and "without a significant difference" in block.summary
    )
    assert [row[0].text for row in hidden.blocks[0].rows] == ["low level against high"]
    shown = [block for block in made.blocks if isinstance(block, Table) and block.head[0][0].text == "test"]
    assert [row[4].text for row in shown[0].rows] == ["z1.piezo is 0.25 ms late"]


@pytest.mark.parametrize(
    ("verdict", "warned"), [(NOTHING_MISSING, False), (EXPLAINED, False), (PARTLY_EXPLAINED, True), (UNEXPLAINED, True)]
)
def test_what_is_left_unexplained_is_warned_of(verdict, warned):
    location = "z3 at 118 Hz in My" if warned else ""
    words = texts(section(given(diagnosis(verdict, hold_out=hold_out(), location=location))), "warn")
    assert (verdict in words.lower()) is warned
    assert ("z3 at 118 Hz" in words) is warned


def test_an_empirical_effect_and_a_missing_hold_out_are_named():
    effect = support_effect()
    effect = replace(effect, evidence=replace(effect.evidence, empirical=True))
    words = texts(section(given(diagnosis(effects=(effect,), chi2_per_dof_after=3.0))), "warn")
    assert "does not explain" in words
    assert "the uncertainties of the parameters below are underestimated" in words
    assert "No run was held out" in words


def test_a_diagnosis_of_nothing_still_makes_a_page():
    last = diagnosis(NOTHING_MISSING, effects=(), trials=(), data_tests=(), untestable_effects=(), notes=())
    empty = replace(last.residual, before=np.full_like(last.residual.before, np.nan), after=last.residual.before)
    made = build_page(given(replace(last, residual=empty)))
    assert not read(made.html).open
    only_sweeps = {"sweep-Mz-high": hold_out()["sweep-Mz-high"]}
    assert "hold-out" not in build_page(given(replace(last, hold_out=only_sweeps))).pictures


def test_two_diagnoses_share_a_page():
    made = build_page(given(diagnosis(hold_out=hold_out()), diagnosis(UNEXPLAINED, hold_out=hold_out())))
    assert made.pictures == ("hold-out", "residual", "hold-out-2", "residual-2")
    assert max(read(made.html).ids.values()) == 1


def test_modes_that_came_in_have_no_partner():
    before = model().modes
    n = len(before.coordinates)
    shape = np.zeros((len(before.frequency) + 1, n + 1), complex)
    shape[:-1, :n], shape[-1, n] = before.shape, 1.0
    after = replace(
        before,
        coordinates=(*before.coordinates, "support.x"),
        frequency=np.append(before.frequency * 1.1, 33.3),
        damping_ratio=np.append(before.damping_ratio, 0.02),
        sigma_frequency=np.append(before.sigma_frequency, 0.1),
        sigma_damping_ratio=np.append(before.sigma_damping_ratio, 0.001),
        shape=shape,
    )
    made = diagnosis(modes_before=before, modes_after=after, chi2_per_dof_before=900.0, chi2_per_dof_after=0.9)
    rows = mode_table(made).rows
    assert len(rows) == len(before.frequency) + 1
    assert rows[0][3].text == "+10.0 %" and rows[0][3].mark == "bad"
    assert rows[0][1].text.endswith("± 0.30") and rows[0][2].text.endswith("± 0.010")
    assert [cell.text for cell in rows[-1]] == ["8", "", "33.30 ± 0.10", "", "", "2.00 ± 0.10"]


def test_the_heat_maps_hold_what_was_given():
    residual = diagnosis().residual
    figure = residual_figure(residual)
    by_run, _, by_channel, _ = (axes.get_images()[0].get_array().filled(np.nan) for axes in figure.axes[:4])
    np.testing.assert_allclose(by_run[1, 5], np.sqrt(np.mean(residual.before[1, 5] ** 2)))
    np.testing.assert_allclose(by_channel[3, 5], np.sqrt(np.mean(residual.before[1:, 5, 3] ** 2)))
    assert np.isnan(by_run[1, 0]) and by_run[0, 0] == pytest.approx(4.0)
