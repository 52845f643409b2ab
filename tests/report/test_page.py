"""The page: what is on it for which artefacts, that it stands alone, and that it says what the artefacts say."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.io.artefacts import Artefact
from balance_cli.reduction.reliability import UnnoticedErrors
from balance_cli.report import summary
from balance_cli.report.check_errors import RelativeError, harmonic_errors, overall_error, pooled_errors
from balance_cli.report.check_runs import section
from balance_cli.report.page import build_page
from balance_cli.report.parameters import section as parameter_section
from balance_cli.report.sources import Sources, group_sources
from balance_cli.report.wind_on import section as wind_section
from tests.support.page_content import read, texts
from tests.support.report_content import artefact, campaign, loads, model


@pytest.fixture(scope="module")
def whole():
    return build_page(group_sources(campaign()))


def test_every_section_of_a_campaign_is_there(whole):
    expected = ["summary", "wind-on", "eigenfrequencies", "shapes", "responses", "parameters", "check-runs", "sweeps"]
    assert list(whole.sections) == [*expected, "calibration", "provenance"]
    assert set(whole.pictures) >= {"check-runs", "redundancy", "harmonics", "eigenfrequencies", "fit", "coherence"}
    assert {"response-Fx", "response-Mz"} <= set(whole.pictures)


def test_the_page_is_well_formed_and_needs_nothing_else(whole):
    tags = read(whole.html)
    assert not tags.open
    assert not tags.outside
    assert "@import" not in whole.html
    assert max(tags.ids.values()) == 1
    assert tags.references <= set(tags.ids)
    assert len(whole.html) < 8e6


def test_the_same_artefacts_give_the_same_bytes(whole):
    assert build_page(group_sources(campaign())).html == whole.html


def test_provenance_names_files_digests_and_times_but_no_folders(whole):
    text = " ".join(read(whole.html).text)
    assert "cal.h5" in text
    assert "somewhere" not in text
    assert "2026-01-02T03:04:05+00:00" in text
    assert "harmonics=3" in text
    assert "d" * 64 in whole.html


KINDS = {
    "balance-calibration/1": {"calibration"},
    "balance-transfer/1": {"responses", "sweeps"},
    "balance-model/1": {"eigenfrequencies", "shapes", "parameters"},
    "balance-loads/1": {"check-runs", "wind-on"},
}


@pytest.mark.parametrize("kind", KINDS)
def test_any_subset_gives_the_sections_it_can(kind):
    some = [(path, item) for path, item in campaign() if item.format == kind]
    made = build_page(group_sources(some))
    assert set(made.sections) == {"summary", "provenance"} | KINDS[kind]
    assert not read(made.html).open


def test_names_from_files_are_not_taken_for_markup():
    content = loads()
    strange = {f"<i>{name}</i>": run for name, run in content.runs.items()}
    made = build_page(group_sources([(Path("<b>.h5"), artefact("balance-loads/1", loads(runs=strange), "1" * 64))]))
    assert "<b>.h5" not in made.html
    assert "<i>" not in made.html
    assert not read(made.html).open


def labels(items: list[tuple[Path, Artefact]]) -> dict[str, str]:
    return {source.file: source.label for source in group_sources(items).all_sources}


def test_loads_bear_the_label_of_their_model():
    found = labels(campaign())
    assert found["loads-model.h5"] == found["model.h5"] == "rigid model (LS+ML)"
    assert found["loads-static.h5"] == "static matrix"
    assert found["loads-tf.h5"] == "measured response"
    looks = {source.file: source.plot_style for source in group_sources(campaign()).all_sources}
    assert looks["loads-model.h5"] == looks["model.h5"]


def test_two_artefacts_of_one_role_are_told_apart_by_their_files():
    first, second = (artefact("balance-model/1", model(), digit * 64) for digit in "12")
    items = [(Path("a/one.h5"), first), (Path("b/two.h5"), second)]
    assert sorted(labels(items).values()) == ["rigid model (LS+ML), one", "rigid model (LS+ML), two"]
    same_names = [(Path("a/one.h5"), first), (Path("b/one.h5"), second)]
    drawn = group_sources(same_names).models
    assert len({source.label for source in drawn}) == 2
    assert len({source.plot_style for source in drawn}) == 2


def test_roles_from_the_words_of_reduce():
    words = {
        "static matrix": "static",
        "measured response (spline)": "measured",
        "physical model (computed)": "computed",
        "physical model (ls)": "ls",
        "physical model (ls+ml)": "identified",
        "paper form (ls+ml, diagonal damping)": "paper",
        "paper form (ls, full damping)": "paper-ls",
        "physical model (ml) with mast-bending": "updated",
        "physical model (computed) with mast-bending": "computed",
        "something new": "other",
    }
    for response, role in words.items():
        (source,) = group_sources([(Path("x.h5"), artefact("balance-loads/1", loads(response), "1" * 64))]).loads
        assert source.role == role, response


def test_an_updated_model_is_called_by_its_effects_and_many_are_counted():
    names = ("mast-bending", "added-mass", "time-delay")
    for used, words in ((names[:2], "mast-bending, added-mass"), (names, "3 effects")):
        effects = tuple(DeclaredEffect(name=name) for name in used)
        updated = model(geometry=model().geometry.model_copy(update={"effects": effects}))
        assert labels([(Path("m.h5"), artefact("balance-model/1", updated, "1" * 64))]) == {
            "m.h5": f"updated model ({words})"
        }
        by = loads(f"physical model (ls+ml) with {', '.join(used)}")
        assert labels([(Path("l.h5"), artefact("balance-loads/1", by, "2" * 64))]) == {
            "l.h5": f"updated model ({words})"
        }


# ---- what the check runs say -----------------------------------------------------------------------------------------


def test_errors_are_pooled_over_the_check_runs():
    content = loads(error=0.5)
    pooled = pooled_errors(content, "load_error")
    assert pooled["Fx"] == RelativeError(0.5, 0.01)
    assert pooled["Fz"].value == pytest.approx(np.sqrt((1.0**2 + 0.5**2) / 2))
    assert pooled_errors(content, "interaction")["Fx"].value == pytest.approx(0.05)
    overall = overall_error(content, "load_error")
    assert overall.value == pytest.approx(np.sqrt((0.5**2 + 1.0**2 + 0.5**2) / 3))


def test_errors_by_harmonic_are_those_of_the_runs_that_applied_the_component():
    content = loads()
    first = content.runs["check-1"]
    applied = first.amplitude / (1.0 + 0.1 * np.arange(4)[:, None])
    runs = {"check-1": replace(first, check=replace(first.check, applied=applied)), "wind-1": content.runs["wind-1"]}
    np.testing.assert_allclose(harmonic_errors(replace(content, runs=runs), "Fx"), [0.1, 0.2, 0.3])
    assert len(harmonic_errors(replace(content, runs=runs), "My")) == 0


def test_the_table_that_matters_shows_every_method_beside_its_noise():
    made = section(group_sources(campaign()))
    table = next(block for block in made.blocks if block.kind == "table")
    assert [cell.text for cell in table.head[0]][1:] == [
        "static matrix",
        "measured response",
        "rigid model (LS+ML)",
    ]
    row = next(row for row in table.rows if row[0].text == "Fx")
    assert [(cell.text, cell.note) for cell in row[1:]] == [("50", "1.0"), ("5.0", "1.0"), ("1.0", "1.0")]
    assert "best" in row[3].mark and "good" in row[3].mark
    assert "good" not in row[1].mark


@pytest.mark.parametrize(("ratio", "warned"), [(1.1, False), (45.0, True)])
def test_a_model_that_does_not_describe_the_data_is_called_so(ratio, warned):
    given = group_sources([(Path("m.h5"), artefact("balance-model/1", model(chi2_per_dof=ratio), "1" * 64))])
    assert ("does not describe" in texts(parameter_section(given), "warn")) is warned


@pytest.mark.parametrize(("ratio", "mark", "said"), [(1.0, "good", False), (0.75, "good", False), (0.6, "", True)])
def test_a_chi_square_that_is_too_small_is_no_praise(ratio, mark, said):
    """With 500 degrees of freedom 0.75 is within five standard deviations of 1."""
    made = summary.section(
        group_sources([(Path("m.h5"), artefact("balance-model/1", model(chi2_per_dof=ratio), "1" * 64))])
    )
    figures = [item for block in made.blocks if block.kind == "figures" for item in block.items]
    assert [item[2] for item in figures if item[1].startswith("chi2/dof")] == [mark]
    points = " ".join(item for block in made.blocks if block.kind == "points" for item in block.items)
    assert "describes the data to within their noise" in points
    assert ("stated too large" in points) is said


def test_wind_on_harmonics_beyond_the_limit_are_counted_and_lost_channels_named():
    given = group_sources([(Path("l.h5"), artefact("balance-loads/1", loads(redundancy=9.0), "1" * 64))])
    words = texts(wind_section(given), "warn")
    assert "1 of 3 harmonics fail the residual test" in words
    assert "channel z2.piezo left out: clipped" in words
    fine = group_sources([(Path("l.h5"), artefact("balance-loads/1", loads(), "1" * 64))])
    assert "fail the residual test" not in texts(wind_section(fine), "warn")


def summary_of(content):
    return summary.section(group_sources([(Path("l.h5"), artefact("balance-loads/1", content, "1" * 64))]))


def test_harmonics_without_redundancy_are_said_not_to_be_tested_and_are_never_green():
    plain = loads()
    untested = {
        name: replace(run, redundancy=np.full(4, np.nan), flags=(("untested",) * 6,) * 4)
        for name, run in plain.runs.items()
    }
    figures = next(block for block in summary_of(replace(plain, runs=untested)).blocks if block.kind == "figures")
    (figure,) = [item for item in figures.items if "wind-on" in item[1]]
    assert figure[0] == "not tested" and "good" not in figure[2]
    figures = next(block for block in summary_of(plain).blocks if block.kind == "figures")
    (figure,) = [item for item in figures.items if "wind-on" in item[1]]
    assert figure[0] == "0 of 3" and "1 not tested" in figure[1] and "good" not in figure[2]


def verdict_table(made):
    (folded,) = [b for b in made.blocks if b.kind == "details" and b.summary.startswith("Flags and verdict")]
    return folded.blocks[0]


def test_the_first_section_says_of_every_run_whether_to_use_it_and_why():
    contradicted = replace(loads().runs["wind-1"], flags=(("model contradicted",) * 6,) * 4)
    made = summary_of(replace(loads(), runs={**loads().runs, "wind-1": contradicted}, warnings=("z2 bridged",)))
    table = verdict_table(made)
    rows = {row[0].text: row for row in table.rows}
    assert rows["check-1"][2].text.startswith("Use with care because the mean loads count from")
    assert rows["wind-1"][2].text.startswith("Do not use because the response misses its own data")
    assert "bad" in rows["wind-1"][2].mark.split() and "model contradicted (24)" in rows["wind-1"][1].text
    assert "z2 bridged" in texts(made, "warn")
    clean = replace(loads().runs["wind-1"], flags=(("",) * 6,) * 4, left_out={})
    table = verdict_table(summary_of(replace(loads(), runs={"wind-1": clean})))
    assert (table.rows[0][1].text, table.rows[0][2].text) == ("none", "Use: all loads were tested and are good.")


def test_loads_of_wind_runs_that_rest_on_one_sensor_are_listed():
    run = loads().runs["wind-1"]
    size = np.abs(run.amplitude[1:])
    change = np.zeros_like(size)
    change[1, 0] = 0.5 * size[1, 0]
    unnoticed = UnnoticedErrors(("cell x",), np.zeros(size.shape, dtype=int), change)
    content = replace(loads(), runs={"wind-1": replace(run, unnoticed=unnoticed)})
    made = wind_section(group_sources([(Path("l.h5"), artefact("balance-loads/1", content, "1" * 64))]))
    (table,) = [block for block in made.blocks if block.kind == "table" and "rest on one sensor" in block.caption]
    ((name, sensor, load, harmonic, *_),) = table.rows
    assert (name.text, sensor.text, load.text, harmonic.text) == ("wind-1", "cell x", run.components[0], "2")


def test_nothing_gives_an_empty_report():
    assert list(build_page(Sources()).sections) == ["summary", "provenance"]


def test_without_loads_the_first_screen_says_so_and_gives_the_key_figures():
    some = [(path, item) for path, item in campaign() if item.format == "balance-calibration/1"]
    made = summary.section(group_sources(some))
    words = texts(made, "text")
    assert "No hub loads: no check or wind run was reduced. This page shows the static calibration." in words
    (figures,) = [block for block in made.blocks if block.kind == "figures"]
    assert "largest residual of the calibration" in figures.items[0][1]


def test_where_no_sensor_is_redundant_the_page_does_not_claim_a_test():
    content = loads()
    untested = {
        name: replace(run, redundancy=np.full(4, np.nan), flags=(("untested",) * 6,) * 4)
        for name, run in content.runs.items()
    }
    item = (Path("l.h5"), artefact("balance-loads/1", replace(content, runs=untested), "1" * 64))
    made = wind_section(group_sources([item]))
    assert "no residual tests the response" in texts(made, "warn")
    assert "redundancy" not in [getattr(block, "name", "") for block in made.blocks]
    # Two channels of each cell: their residuals are small, and test the channels alone.
    pairs = {name: replace(run, redundancy=content.runs[name].redundancy) for name, run in untested.items()}
    item = (Path("l.h5"), artefact("balance-loads/1", replace(content, runs=pairs), "1" * 64))
    made = wind_section(group_sources([item]))
    assert "no residual tests the response" in texts(made, "warn")
    (sentences,) = [block for block in made.blocks if block.kind == "points"]
    assert [item.endswith("nothing tests the response.") for item in sentences.items] == [True]
