"""The page of a diagnosis: what it shows of verdict, effects, errors, residual and trials."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from balance_cli.diagnosis.result import EXPLAINED, NOTHING_MISSING, PARTLY_EXPLAINED, UNEXPLAINED, HoldOut, RunErrors
from balance_cli.report.blocks import BulletList, Chart, Details, Paragraph, Table
from balance_cli.report.diagnosis import section, verdict_sentence
from balance_cli.report.diagnosis_errors import pooled_hold_out_errors
from balance_cli.report.diagnosis_figures import residual_figure
from balance_cli.report.diagnosis_residual import residual_shares
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
    # The pictures of the calibration take most of the time, and are tested elsewhere.
    everything = [
        *(item for item in campaign() if item[1].format in ("balance-loads/1", "balance-model/1")),
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
    assert "a tap on the support" in words and "Gyroscopic-coupling was not tested: all runs are at rest" in words


def test_what_changes_no_load_is_not_found_beside_a_verdict_of_nothing_missing():
    """The page said "nothing missing. Found:" and ten zeros of channels."""
    light = replace(support_effect(), worth={"Fx": 0.0, "Mz": 0.05})
    (source,) = given(diagnosis(NOTHING_MISSING, effects=(light, light))).diagnoses
    assert "Found:" not in verdict_sentence(source)
    assert verdict_sentence(source).endswith(f"Found, of no consequence to any load: {light.name}.")
    (source,) = given(diagnosis(effects=(light, replace(light, worth={"Fx": 3.0})))).diagnoses
    assert f" Found: {light.label}. " in verdict_sentence(source)


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
    names = ("residual-frequency", "residual", "hold-out")
    assert made.pictures == (*names, *(f"{name}-2" for name in names))
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


def story_text(made) -> str:
    shown = [block for block in made.blocks if isinstance(block, (BulletList, Paragraph))]
    return " ".join(" ".join(block.items) if isinstance(block, BulletList) else block.text for block in shown)


def with_excitation(made, correlation_after: float = 0.02):
    """The diagnosis with the excited component of each run, and correlations of 1000 pairs of lines."""
    shape = (len(made.residual.channels), 20)
    residual = replace(
        made.residual,
        excited=("", "Fx", "Fx"),
        correlation_before=np.full(shape, 0.9),
        correlation_after=np.full(shape, correlation_after),
        pairs=np.full(shape, 1000.0),
    )
    return replace(made, residual=residual, dof=10_000.0)


def test_the_story_says_where_the_residual_was_and_what_each_effect_took_away():
    made = section(given(with_excitation(diagnosis(hold_out=hold_out()))))
    words = story_text(made)
    assert "with the excitation Fx (100 %)" in words
    # Chi-square 812.3 of 10 000 degrees of freedom, beside a chi2/dof of 1.04.
    assert "Without it chi2/dof would be 1.12 in place of 1.04" in words
    assert "mast-bending@x 92 % of what it gained" in words
    misfit = replace(with_excitation(diagnosis(hold_out=hold_out())), chi2_per_dof_after=1880.0)
    assert "Without it chi2/dof" not in story_text(section(given(misfit)))
    assert "Mast-bending@x: gains less" in words
    assert "the error of My goes from 1270 % to 0.31 %" in words
    assert row_of(made, "Mx", "time-delay@z1.piezo") == ["time-delay@z1.piezo", "31", "4.2"]


def test_shares_of_the_residual_are_those_of_its_excess_over_the_noise():
    residual = with_excitation(diagnosis()).residual
    shares = residual_shares(residual)
    assert {kind: round(sum(part.share for part in parts), 9) for kind, parts in shares.items()} == dict.fromkeys(
        ("channel", "frequency", "excited component"), 1.0
    )
    excess = np.nan_to_num(np.maximum(residual.before**2 - 1.0, 0.0))
    by_channel = {part.name: part.share for part in shares["channel"]}
    assert by_channel[residual.channels[3]] == pytest.approx(excess[:, :, 3].sum() / excess.sum())


@pytest.mark.parametrize(("correlation", "above"), [(0.02, 0), (0.2, 300)])
def test_whiteness_counts_correlations_above_their_limit(correlation, above):
    """The limit of 1000 pairs is sqrt(3 / 1000) = 0.055."""
    made = section(given(with_excitation(diagnosis(), correlation)))
    chart = next(block for block in made.blocks if isinstance(block, Chart) and block.name == "whiteness")
    assert f"{above} of 300" in chart.caption


def test_what_remains_is_said_with_the_verdict():
    explained = story_text(section(given(diagnosis(hold_out=hold_out()))))
    assert "Nothing remains in these data beyond their noise. Open is:" in explained
    assert "Support-flexibility@x,theta cannot be told from mast-bending@x with these runs: a tap on" in explained
    unexplained = diagnosis(UNEXPLAINED, effects=(), hold_out=hold_out(), location="Rms 3 of the noise; most in z3.")
    words = story_text(section(given(unexplained)))
    assert "of 61 candidates none was accepted" in words and "(Rms 3 of the noise; most in z3)" in words
    assert "Nothing remains" not in words


def test_a_residual_of_noise_alone_names_no_place():
    made = diagnosis(NOTHING_MISSING, effects=(), hold_out=hold_out())
    quiet = replace(made, residual=replace(made.residual, before=0.2 + 0.8 * made.residual.after))
    shown = section(given(with_excitation(quiet)))
    assert "There was nothing beyond the noise to explain" in story_text(shown)
    assert not any(isinstance(block, Table) and "share of the excess" in texts_of_head(block) for block in shown.blocks)


def texts_of_head(table) -> list[str]:
    return [cell.text for row in table.head for cell in row]
