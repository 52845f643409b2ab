"""The first screen: which loads are recommended and why, and what it says of every load."""

import base64
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from balance_cli.reduction.flags import trust_text
from balance_cli.report.answer import MOST_CARDS, answer_blocks
from balance_cli.report.azimuth import DEGREES, waveform, waveform_sigma
from balance_cli.report.few_runs import RUNS_SHOWN, condense, with_runs
from balance_cli.report.page import build_page
from balance_cli.report.recommendation import rank_methods
from balance_cli.report.sources import group_sources
from tests.support.report_content import artefact, campaign, loads


def sources_of(*contents):
    return group_sources(
        [(Path(f"l{i}.h5"), artefact("balance-loads/1", content, f"{i}" * 64)) for i, content in enumerate(contents)]
    ).loads


def cards(blocks):
    return {card.title: card for block in blocks if block.kind == "cards" for card in block.cards}


def with_flags(content, word):
    runs = {name: replace(run, flags=((word,) * 6,) * 4) for name, run in content.runs.items()}
    return replace(content, runs=runs)


def test_the_first_screen_holds_the_loads_of_the_wind_run_by_the_best_method():
    blocks = list(answer_blocks(group_sources(campaign()).loads))
    assert blocks[0].text.startswith("Recommended loads: by the rigid model (LS+ML), of 3 methods compared.")
    assert "error on known loads (check-1 and check-2) is 1.4 %" in blocks[0].text
    assert "harmonics in wind-1 " in blocks[0].text  # not those of the check runs that the sentence names, too
    (card,) = cards(blocks).values()
    assert card.title == "wind-1" and card.badge == "use with care"
    assert [cell.text for cell in card.head[0]] == ["", "mean", "1/rev", "trust"]
    fx = card.rows[0]
    assert [(cell.text, cell.note) for cell in fx[1:3]] == [("10.000", "± 0.020"), ("5.000", "± 0.020")]
    assert (fx[3].text, fx[3].title) == ("no zero", "mean: no zero; 1/rev: tested and good")


def test_the_only_method_given_is_not_called_recommended():
    blocks = list(answer_blocks(sources_of(loads("physical model (ls+ml)", 0.4))))
    assert blocks[0].text.startswith("The only loads given: by the rigid model (LS+ML). Its error on known loads")


def test_a_method_without_dynamics_is_never_recommended_over_one_that_was_measured():
    rigid = with_flags(loads("physical model (ls+ml)", 0.4), "model contradicted")
    static = with_flags(loads("static matrix", 0.01), "untested")
    ranked = rank_methods(sources_of(static, rigid))
    assert [source.label for source in ranked] == ["rigid model (LS+ML)", "static matrix"]
    card = cards(answer_blocks(sources_of(static, rigid)))["wind-1"]
    assert card.mark == "bad" and card.sentence.startswith("Do not use because the response misses")


def test_a_method_that_is_clearly_worse_on_known_loads_comes_later():
    model, measured = loads("physical model (ls+ml)", 0.4), loads("measured response (local)", 0.01)
    assert rank_methods(sources_of(model, measured))[0].label == "measured response"
    close = loads("measured response (local)", 0.35)
    assert rank_methods(sources_of(model, close))[0].label == "rigid model (LS+ML)"


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        ("", "tested and good"),
        ("untested", "not tested"),
        ("no zero; not steady", "not steady"),
        ("untested; redundancy; not steady", "contradicted"),
        ("not measured", "not measured"),
    ],
)
def test_trust_names_the_worst_flag(flags, text):
    assert trust_text(flags) == text


def test_many_runs_are_in_an_index_that_sorts_with_a_curve_and_the_loads_of_each():
    content = loads()
    runs = {f"w{i}": replace(content.runs["wind-1"], run=f"w{i}") for i in range(20)}
    blocks = list(answer_blocks(sources_of(replace(content, runs=runs))))
    assert len(cards(blocks)) == MOST_CARDS
    (index,) = [block for block in blocks if block.kind == "index"]
    table = index.table
    # The last column holds the curve.
    assert table.sortable and len(table.rows) == 20 and {len(row) for row in table.rows} == {len(table.head[0]) - 1}
    assert len(index.curves) == 20 and index.curves[3].count("L") == 30
    data = json.loads(index.data)
    values = np.frombuffer(base64.b64decode(data["runs"][7]["d"]), "<f4").reshape(4, 6, 4)
    run = runs["w7"]
    np.testing.assert_allclose(values[..., 0] - 1j * values[..., 1], run.amplitude, rtol=1e-6)
    np.testing.assert_allclose(values[..., 2], run.sigma_cosine, rtol=1e-6)
    flags = [data["flags"][int(data["runs"][7]["w"][i : i + 2], 36)] for i in range(0, 48, 2)]
    assert flags == [flag for row in run.flags for flag in row]


def test_of_very_many_runs_the_worst_are_shown_in_full_and_the_index_holds_all():
    content = loads()
    run = content.runs["wind-1"]
    bad = replace(run, run="bad", flags=(("redundancy",) * 6,) * 4)
    runs = {f"w{i:02}": replace(run, run=f"w{i:02}") for i in range(30)} | {"bad": bad}
    sources = group_sources([(Path("l.h5"), artefact("balance-loads/1", replace(content, runs=runs), "1" * 64))])
    few, words = condense(sources)
    assert list(few.loads[0].content.runs) == [*(f"w{i:02}" for i in range(RUNS_SHOWN - 1)), "bad"]
    assert f"{RUNS_SHOWN} of 31 runs" in words
    html = build_page(sources).html
    assert words in html and html.count("<tr data-run=") == 31
    assert condense(with_runs(sources, {"bad"}))[1] == ""
    alone = build_page(with_runs(sources, {"bad"})).html
    assert "w03" not in alone and "do not use" in alone


def test_wrong_methods_stand_below_the_answer():
    html = build_page(group_sources([item for item in campaign() if item[1].format == "balance-loads/1"])).html
    assert html.index('class="cards"') < html.index('id="picture-azimuth"') < html.index('id="check-runs"')


def test_the_load_over_azimuth_is_the_sum_of_its_harmonics():
    amplitude = np.array([5.0, 2.0 - 3.0j, 0.0, 1.0j])
    psi = np.radians(DEGREES)
    expected = 5.0 + 2.0 * np.cos(psi) + 3.0 * np.sin(psi) - np.sin(3 * psi)
    np.testing.assert_allclose(waveform(amplitude), expected, atol=1e-12)
    np.testing.assert_allclose(waveform(amplitude, mean=False), expected - 5.0, atol=1e-12)
    run = loads().runs["wind-1"]
    np.testing.assert_allclose(waveform_sigma(run, 0), 0.02 * np.sqrt(1.0 + 3.0 * 1.0), rtol=1e-12)


def test_loads_that_must_not_be_used_are_not_recommended():
    (source,) = sources_of(with_flags(loads("physical model (ls+ml)"), "redundancy"))
    first = next(iter(answer_blocks([source]))).text
    assert first.startswith("Do not use these loads, the only ones given: ") and "Recommended" not in first
