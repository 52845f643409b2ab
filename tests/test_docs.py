"""The manual says what the programs do: links, commands, options, keys, columns and figures are held to the code."""

import importlib.util
import json
import re
import sys
from pathlib import Path

import click
import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from pydantic import BaseModel

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.cli import COMMANDS, balance
from balance_cli.reduction.result import LOAD_TABLE_COLUMNS
from balance_cli.signals.anti_alias import anti_alias_response
from balance_cli.simulation.plans import RotorPlan, StaticPlan, SweepPlan, ZeroPlan
from balance_cli.steps.modes import computed_modes
from tests.support.diagnosis_content import fake_diagnose_module
from tests.support.rigs import rotor_balance
from tests.support.tools import tool

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
CODE = re.compile(r"`([^`\n]+)`")


def text_of(page: Path) -> str:
    """A page without its blocks of code and formulas."""
    return re.sub(r"^(```|\$\$).*?^\1", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """The anchors that a page's headings get."""
    headings = re.findall(r"^#+ (.+)$", text_of(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def listed_commands() -> list[str]:
    return balance.list_commands(click.Context(balance))


def named(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_lead_somewhere(page):
    lost = []
    for link in LINK.findall(text_of(page)):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            lost.append(link)
    assert not lost


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_files_that_are_named_exist(page):
    paths = [
        code for code in CODE.findall(text_of(page)) if re.match(r"(balance_cli|configs|docs|tools|tests)/\S", code)
    ]
    assert [path for path in paths if not (ROOT / path).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_options_that_are_named_exist(page):
    commands = [balance.get_command(click.Context(balance), name) for name in listed_commands()]
    known = {name for command in [balance, *commands] for item in command.params for name in item.opts} | {"--help"}
    asked = set(re.findall(r"(?<![\w-])--[a-z][a-z0-9-]+", " ".join(CODE.findall(text_of(page)))))
    assert asked <= known


def test_command_reference_is_that_of_the_commands():
    written = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    assert written == tool("cli_reference").reference(), "docs/commands.md is out of date: run `make docs`"


def test_pages_of_effects_are_those_of_the_effects():
    expected = tool("effect_pages").pages()
    written = {page: page.read_text(encoding="utf-8") for page in [*ROOT.glob("docs/effects/*.md"), *expected]}
    assert written == expected, "the pages of the effects are out of date: run `make docs`"


def test_readme_lists_every_command():
    table = re.findall(r"^\| `balance ([a-z-]+)", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert len(table) == len(set(table))
    assert set(listed_commands()) <= set(table) <= set(COMMANDS)


def test_decisions_are_listed_and_whole():
    folder = ROOT / "docs" / "adr"
    pages = sorted(folder.glob("[0-9]*.md"))
    assert [page.name for page in pages] == LINK.findall(text_of(folder / "README.md"))
    for number, page in enumerate(pages, 1):
        text = page.read_text(encoding="utf-8")
        assert text.startswith(f"# {number}. ") and page.name.startswith(f"{number:04d}-")
        assert re.findall(r"^## (.+)$", text, re.MULTILINE) == ["Context", "Decision", "Consequences"]
        assert "**Status:**" in text


def test_references_that_are_cited_are_listed():
    listed = (ROOT / "docs" / "theory.md").read_text(encoding="utf-8").partition("## References")[2]
    entries = [" ".join(entry.split()) for entry in listed.split("\n- ")]
    cited = []
    for page in sorted((ROOT / "docs" / "theory").glob("*.md")):
        text = " ".join(text_of(page).split())
        cited += re.findall(r"([A-Z]\w+)(?:, [\w ]+)?(?: and [\w ]+)?,? \(?((?:19|20)\d\d)\b", text)
    assert len(cited) > 20
    unknown = [(name, year) for name, year in cited if not any(name in e and year in e for e in entries)]
    assert unknown == []


# ---- files -----------------------------------------------------------------------------------------------------------


def section(page: str, heading: str) -> set[str]:
    """Words in code style in one section of a page."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    part = re.search(rf"^## {re.escape(heading)}.*?(?=^## |\Z)", text, re.DOTALL | re.MULTILINE)
    assert part, f"{page} has no section {heading}"
    return {word for code in CODE.findall(part[0]) for word in re.findall(r"[\w./+-]+", code)}


def keys(model: type[BaseModel]) -> set[str]:
    """All keys of a declared file, with those of its parts."""
    found = set(model.model_fields)
    parts = re.findall(r"\.(\w+)'?[>,\]| ]", " ".join(str(field.annotation) for field in model.model_fields.values()))
    for name in set(parts):
        part = getattr(importlib.import_module(model.__module__), name, None)
        if isinstance(part, type) and issubclass(part, BaseModel):
            found |= keys(part)
    return found


def test_every_key_of_a_geometry_is_in_the_manual():
    declared = keys(Geometry)
    assert {"hub", "full_range", "cutoff", "centre_of_gravity", "blades", "xz"} <= declared
    assert declared <= section("files.md", "Geometry: YAML")


def test_every_setting_of_a_plan_is_in_the_manual():
    declared = set().union(*(keys(plan) for plan in (StaticPlan, ZeroPlan, SweepPlan, RotorPlan)))
    assert {"largest", "interleaved", "turbulence"} <= declared
    assert declared <= section("files.md", "Simulated campaigns")


def test_every_column_of_the_loads_is_in_the_manual():
    assert set(LOAD_TABLE_COLUMNS) <= section("files.md", "LOADS: `.csv` or `.h5`")


# ---- summaries -------------------------------------------------------------------------------------------------------

# Keys under which a summary has names (of runs, channels, components ...) instead of keys, and how many levels of them.
NAMES = {
    **dict.fromkeys(
        ("trims", "files", "runs", "skipped", "left_out", "artefacts", "sections", "steady", "parameters", "hold_out"),
        1,
    ),
    **dict.fromkeys(("unnoticed_errors", "changes"), 2),
    **dict.fromkeys(("full_scale", "is_rated_load", "largest_percent_fs", "largest_at", "check_points"), 1),
    **dict.fromkeys(("standard_deviation_percent_fs", "two_sigma_percent_fs"), 1),
    **dict.fromkeys(("residual_percent_fs", "full_range", "mean_load", "channel_residual_percent_fs"), 1),
    **dict.fromkeys(("hysteresis_percent_fs", "sensitivity", "sensitivities", "stiffness"), 1),
    **dict.fromkeys(("coherence_min", "relative_sigma", "redundancy", "redundancy_limit", "condition"), 1),
    **dict.fromkeys(("load_error", "interaction", "load_noise", "interaction_noise", "worth"), 1),
    **dict.fromkeys(("unsupported_terms", "residual", "press", "cross_validation", "reach", "drift_per_series"), 1),
    **dict.fromkeys(("terms_refused", "left_out_sequences", "drift_per_sequence", "calibrated_range"), 1),
    **dict.fromkeys(("scatter_chi2_per_dof", "checks", "error_percent_fs", "within_interval"), 1),
    **dict.fromkeys(("channels", "noise_v", "flags", "campaign_runs", "steps", "steps_left_out", "trust", "error"), 1),
    **dict.fromkeys(("reference", "sigma_before", "sigma_after", "sigma_after_run", "sigma_noise"), 1),
    **dict.fromkeys(("terms", "linear", "C0", "T0", "channel_hysteresis", "channels_left_out", "gaps"), 2),
}


def keys_of(value: object, levels: int = 0) -> set[str]:
    """All keys of a summary; the outer `levels` hold names."""
    if isinstance(value, list):
        return set().union(*(keys_of(item) for item in value)) if value else set()
    if not isinstance(value, dict):
        return set()
    inner = [keys_of(item, levels - 1 if levels else NAMES.get(key, 0)) for key, item in value.items()]
    return set().union(set() if levels else value, *inner)


@pytest.fixture(scope="module")
def summaries(tmp_path_factory):
    """The summary of a small call of every command."""
    folder = tmp_path_factory.mktemp("summaries")
    data = ROOT / "sample_data"
    g = ["-g", str(ROOT / "configs" / "rts-6.yaml")]
    plan = {
        "runs": [{"run": "zero", "kind": "zero", "duration": 0.5}, {"run": "s", "kind": "static", "largest": {"Fz": 9}}]
    }
    (folder / "plan.yaml").write_text(yaml.safe_dump(plan))
    hall = {
        "exciters": {"Fz": {"rms": 80}},
        "change_minutes": 1,
        "period": 1.0,
        "periods": [2],
        "effects": ["low-pass", "time-delay"],
    }
    (folder / "hall.yaml").write_text(yaml.safe_dump({"format": "balance-hall/1", **hall}))
    names = ("static-bare", "sweep-Fz-high", "check-1", "wind-1")
    static, sweep, check, wind = (str(data / f"{name}.h5") for name in names)
    (folder / "runs").mkdir()
    for name in names:
        (folder / "runs" / f"{name}.h5").symlink_to(data / f"{name}.h5")
    cal, out, model = (str(folder / name) for name in ("cal.h5", "out.h5", "model.h5"))
    (folder / "table.csv").write_text("a [V],Fz [N],t [s]\n" + "".join(f"{k % 7},{k % 5},{k / 8}\n" for k in range(99)))
    import_map = {
        "format": "balance-import/1",
        "rig": "r",
        "time": "t",
        "channels": {"a": "z1"},
        "runs": [{"file": "*", "kind": "zero"}],
    }
    (folder / "map.yaml").write_text(yaml.safe_dump(import_map))
    (folder / "frf.csv").write_text(
        "\n".join(["f [Hz],re [V/N],im [V/N]", *(f"{k},1.{k % 7},-0.{k % 5}" for k in range(99))])
    )
    calls = {
        "import-frf": ["--sketch", str(folder / "frf.csv")],
        "import": [str(folder / "map.yaml"), str(folder / "table.csv"), "-o", str(folder / "imported")],
        "calibrate": [*g, static, "-o", cal],
        "apply": [cal, static, "--zero", "first", "-o", str(folder / "points.csv")],
        "sweep-tf": [*g, sweep, "--to", "20", "-o", out],
        "identify": [*g, sweep, static, "--method", "computed", "-o", model],
        "diagnose": [model, sweep, "--hold-out", check, "-o", out, "--model-out", str(folder / "closed.h5")],
        "reduce": ["--calibration", cal, "--model", model, "--method", "smoother", check, wind, "-o", out],
        "merge": [out, "-o", str(folder / "merged.h5")],
        "trend": [out],
        "modes": g,
        "plan": [*g, "--hall", str(folder / "hall.yaml"), "--minutes", "3", "-o", str(folder / "planned.yaml")],
        "simulate": [*g, "--plan", str(folder / "plan.yaml"), "-o", str(folder / "campaign")],
        "check": [static, str(ROOT / "pyproject.toml"), *g],
        "report": [cal, "-o", str(folder / "report.html")],
        "run": [str(folder / "runs"), *g, "-o", str(folder / "results"), "--dry-run"],
        "export": [out, "-o", str(folder / "loads.csv")],
        "watch": [str(folder / "campaign"), "--model", model, "-o", str(folder / "watched"), "--once"],
    }
    found = {}
    for name, words in calls.items():
        path = folder / f"{name}.json"
        # The loop itself takes its time, and finds nothing in so little: one by hand has all keys.
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(sys.modules, "balance_cli.steps.diagnose", fake_diagnose_module())
            result = CliRunner().invoke(balance, [name, *words, "--json", str(path)])
        assert result.exit_code == (2 if name == "check" else 0), result.output
        found[name] = json.loads(path.read_text(encoding="utf-8"))
    return found


def test_a_summary_of_every_command_is_looked_at(summaries):
    assert set(summaries) == set(listed_commands())


def test_every_key_of_the_summaries_is_in_the_manual(summaries):
    common = section("json.md", "All commands")
    missing = {
        name: sorted(keys_of(summary) - common - section("json.md", name)) for name, summary in summaries.items()
    }
    assert {name: left for name, left in missing.items() if left} == {}


def test_keys_are_collected_below_names():
    summary = {"runs": {"a": {"chi2": 1}}, "C0": {"z": {"Fx": {"value": 1}}}, "modes": [{"zeta": 1}]}
    assert keys_of(summary) == {"runs", "chi2", "C0", "value", "modes", "zeta"}


# ---- figures ---------------------------------------------------------------------------------------------------------


def test_what_the_manual_says_of_the_filter():
    text = (ROOT / "docs" / "theory" / "balance.md").read_text(encoding="utf-8")
    forgotten = 100 * np.abs(anti_alias_response(rotor_balance().acquisition, [17.5, 140.0]) - 1)
    first, eighth = re.search(r"(\d+) % at 1/rev and (\d+) % at 8/rev", " ".join(text.split())).groups()
    assert [int(first), int(eighth)] == np.rint(forgotten).tolist()


def test_what_the_readme_says_of_the_computed_frequencies():
    text = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    computed = computed_modes(rotor_balance()).modes.frequency[-2:]
    assert re.findall(r"([\d.]+) Hz against", text) == [f"{frequency:.1f}" for frequency in computed]
