"""`make study`: run the studies that are missing, and write their tables."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click
import numpy as np
import pandas as pd

from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.report.figure_style import save_picture
from balance_cli.simulation import Noise, draw_rig, simulate_campaign
from studies.attribution import attribution_chunk
from studies.attribution_tables import attribution_table
from studies.blind.judge import BLIND_KINDS, blind_chunk, blind_table
from studies.calibration import calibration_chunk, calibration_table
from studies.calibration_rows import rows_chunk, rows_table
from studies.calibration_schedules import schedules_chunk, schedules_table
from studies.cases import KINDS, case, count
from studies.chunks import run_chunks
from studies.clean_campaigns import clean_chunk, clean_table
from studies.clean_warnings import warnings_chunk, warnings_table
from studies.consistency import consistency_table, table_in_page
from studies.consistency_cases import CASES
from studies.consistency_other_rigs import OTHER_RIGS, other_cases
from studies.consistency_rigs import campaign_of, rigs
from studies.coverage import CoverageTask, coverage_chunk, coverage_table
from studies.coverage_by_fault import fault_chunk, fault_table
from studies.filters import filters_chunk
from studies.filters_picture import filters_picture
from studies.filters_table import filters_table, page_table
from studies.interruptions.__main__ import interruptions
from studies.lacking import lacking_table
from studies.maneuver import maneuver_chunk, maneuver_table
from studies.mishaps import MISHAPS, mishap_table
from studies.mutation.__main__ import main as mutation
from studies.planning import CHUNKS, planning_chunk, planning_table
from studies.recovery import recovery_chunk, recovery_table
from studies.steadiness import steadiness_chunk, steadiness_table

TABLES = Path(__file__).parent / "tables"
PICTURES = Path(__file__).parents[1] / "docs" / "pictures"
GEOMETRY = Path(__file__).parents[1] / "configs" / "rts-6.yaml"
CONSISTENCY_PAGE = Path(__file__).parents[1] / "docs" / "consistency.md"
FITS_PER_RIG = 50


@click.group(invoke_without_command=True)
@click.pass_context
def studies(context: click.Context) -> None:
    """Statistical studies on simulated campaigns; without a name, all of them."""
    if context.invoked_subcommand is None:
        context.invoke(coverage)
        context.invoke(recovery)
        context.invoke(attribution)
        context.invoke(calibration)
        context.invoke(schedules)
        context.invoke(maneuver)
        context.invoke(filters)


@studies.command()
def consistency() -> None:
    """What the cross-checks say of campaigns that are plausible and wrong; the table in docs/consistency.md."""
    geometry = rigs()["sample"]
    rig = draw_rig(geometry, np.random.default_rng(1))
    runs = simulate_campaign(rig, campaign_of("sample", geometry), Noise(), 1).runs
    table = consistency_table(geometry, runs, CASES)
    _write("consistency", table)
    table_in_page(table, CONSISTENCY_PAGE)
    click.echo(f"{(table['named'] == 'yes').sum()} of {len(table)} campaigns named")


@studies.command("consistency-other-rigs")
def consistency_other_rigs() -> None:
    """The same on rigs with one channel in each cell."""
    tables = []
    for name in OTHER_RIGS:
        geometry = rigs()[name]
        rig = draw_rig(geometry, np.random.default_rng(1))
        runs = simulate_campaign(rig, campaign_of(name, geometry), Noise(), 1).runs
        tables.append(consistency_table(geometry, runs, other_cases(name)).assign(rig=name))
    table = pd.concat(tables, ignore_index=True)
    _write("consistency_other_rigs", table)
    click.echo(f"{(table['named'] == 'yes').sum()} of {len(table)} campaigns named")


@studies.command()
@click.option("--rigs", default=20, show_default=True)
@click.option("--jobs", default=2, show_default=True)
def coverage(rigs: int = 20, jobs: int = 2) -> None:
    """Coverage of the 95 % intervals over 50 fits of every rig."""
    errors = run_chunks("coverage", _coverage, range(rigs), jobs)
    table = coverage_table(errors)
    pooled = errors["error"].abs().lt(1.959963984540054).groupby(errors["rests_on"]).agg(["mean", "size"])
    _write("coverage", table)
    click.echo(table.to_string(index=False))
    click.echo(pooled.to_string())


@studies.command()
@click.option("--campaigns", default=20, show_default=True)
@click.option("--jobs", default=2, show_default=True)
def recovery(campaigns: int = 20, jobs: int = 2) -> None:
    """Responses and hub loads from whole simulated campaigns against the truth."""
    table = recovery_table(run_chunks("recovery", _recovery, range(campaigns), jobs))
    _write("recovery", table)
    click.echo(table.to_string(index=False))


@studies.command()
@click.option("--jobs", default=2, show_default=True)
def planning(jobs: int = 2) -> None:
    """Detection rate and sigma that `plan` predicts, against those of simulated campaigns."""
    table = planning_table(run_chunks("planning", planning_chunk, range(CHUNKS), jobs))
    _write("planning", table)
    click.echo(table.to_string(index=False))


@studies.command()
@click.option("--kind", "kinds", multiple=True, type=click.Choice(KINDS), help="Only these kinds of campaigns.")
@click.option("--campaigns", default=None, type=int, help="The first of each kind only.")
@click.option("--jobs", default=2, show_default=True)
def attribution(kinds: tuple[str, ...] = (), campaigns: int | None = None, jobs: int = 2) -> None:
    """What the loop says of campaigns with effects hidden, and of campaigns with nothing hidden."""
    parts = []
    for kind in kinds or KINDS:
        seeds = range(count(kind) if campaigns is None else min(campaigns, count(kind)))
        parts.append(run_chunks(f"attribution-{kind}", partial(_attribution, kind), seeds, jobs))
    rows = pd.concat(parts, ignore_index=True)
    table = attribution_table(rows)
    _write("attribution", table)
    _write("attribution_campaigns", rows)
    click.echo(table.to_string(index=False))


@studies.command()
@click.option("--balances", default=100, show_default=True)
@click.option("--jobs", default=2, show_default=True)
def calibration(balances: int = 100, jobs: int = 2) -> None:
    """Terms found, coverage on check loads and back-calculated loads of simulated static calibrations."""
    rows = run_chunks("calibration", calibration_chunk, range(balances), jobs)
    table = calibration_table(rows)
    _write("calibration", table)
    click.echo(table.to_string(index=False))


@studies.command()
@click.option("--seeds", default=20, show_default=True)
@click.option("--jobs", default=2, show_default=True)
def schedules(seeds: int = 20, jobs: int = 2) -> None:
    """Mistakes named, coverage, and errors over those of plain least squares, by schedule of a static calibration."""
    table = schedules_table(run_chunks("schedules", schedules_chunk, range(seeds), jobs))
    _write("schedules", table)
    click.echo(table.to_string(index=False))


@studies.command("calibration-rows")
@click.option("--seeds", default=20, show_default=True)
@click.option("--jobs", default=2, show_default=True)
def calibration_rows(seeds: int = 20, jobs: int = 2) -> None:
    """Coverage of the intervals of loads, from 10 to 1000 rows and from 1 to 30 load series of a static calibration."""
    table = rows_table(run_chunks("calibration_rows", rows_chunk, range(seeds), jobs))
    _write("calibration_rows", table)
    click.echo(table.to_string(index=False))


@studies.command()
@click.option("--seeds", default=10, show_default=True)
@click.option("--jobs", default=2, show_default=True)
def maneuver(seeds: int = 10, jobs: int = 2) -> None:
    """Filters and smoothers on maneuvers with known loads, compared with the best linear smoother."""
    table = maneuver_table(run_chunks("maneuver", _maneuver, range(seeds), jobs))
    _write("maneuver", table)
    click.echo(table.to_string(index=False))


studies.add_command(interruptions)
studies.add_command(mutation, "mutation")
# The former name, for scripts.
studies.add_command(click.Command("manoeuvre", callback=maneuver.callback, params=maneuver.params, hidden=True))


@studies.command()
@click.option("--seeds", default=10, show_default=True)
@click.option("--jobs", default=2, show_default=True)
def filters(seeds: int = 10, jobs: int = 2) -> None:
    """Frequency domain and Kalman filters on a balance with two degrees of freedom, with a picture."""
    table = filters_table(run_chunks("filters", filters_chunk, range(seeds), jobs))
    _write("filters", table)
    save_picture(PICTURES / "filters.png", "filters", lambda: filters_picture(table), "png")
    click.echo(page_table(table))


@studies.command("clean-campaigns")
@click.option("--campaigns", default=100, show_default=True)
@click.option("--first", default=0, show_default=True, help="First seed: others are other campaigns.")
@click.option("--jobs", default=2, show_default=True)
def clean_campaigns(campaigns: int = 100, first: int = 0, jobs: int = 2) -> None:
    """Rows that are flagged although nothing is wrong, and coverage, on five rigs."""
    table = clean_table(run_chunks("clean-campaigns", clean_chunk, range(first, first + campaigns), jobs))
    _write("clean_campaigns", table)
    click.echo(table.to_string(index=False))


@studies.command("clean-warnings")
@click.option("--campaigns", default=100, show_default=True)
@click.option("--first", default=0, show_default=True, help="First seed: others are other campaigns.")
@click.option("--jobs", default=2, show_default=True)
def clean_warnings(campaigns: int = 100, first: int = 0, jobs: int = 2) -> None:
    """Warnings of the commands on clean campaigns of five rigs: all of them are false."""
    table = warnings_table(run_chunks("clean-warnings", warnings_chunk, range(first, first + campaigns), jobs))
    _write("clean_warnings", table)
    click.echo(table.to_string(index=False))


@studies.command()
@click.option("--seeds", default=10, show_default=True)
@click.option("--jobs", default=2, show_default=True)
def steadiness(seeds: int = 10, jobs: int = 2) -> None:
    """Which rows are flagged in records whose loads change within them, by change and length."""
    table = steadiness_table(run_chunks("steadiness", steadiness_chunk, range(seeds), jobs))
    _write("steadiness", table)
    click.echo(table.to_string(index=False))


@studies.command()
@click.option(
    "--mishap", "names", multiple=True, type=click.Choice(list(MISHAPS)), metavar="MISHAP", help="Only these."
)
@click.option("--seed", default=1, show_default=True)
def mishaps(names: tuple[str, ...] = (), seed: int = 1) -> None:
    """What checks and the chain to the loads say of plausible runs that went wrong."""
    table = mishap_table(names or tuple(MISHAPS), seed)
    _write("mishaps", table)
    click.echo(table.to_string(index=False))


@studies.command("coverage-by-fault")
@click.option("--seeds", default=4, show_default=True)
@click.option("--jobs", default=1, show_default=True)
def coverage_by_fault(seeds: int = 4, jobs: int = 1) -> None:
    """Coverage and flags of hub loads by what is wrong with a campaign or its reduction."""
    table = fault_table(run_chunks("coverage-by-fault", fault_chunk, range(seeds), jobs))
    _write("coverage_by_fault", table)
    click.echo(table.to_string(index=False))


@studies.command()
@click.option("--kind", type=click.Choice(list(BLIND_KINDS)), default="drawn", show_default=True)
@click.option("--first", default=0, show_default=True, help="First seed.")
@click.option("--campaigns", default=30, show_default=True)
@click.option("--jobs", default=2, show_default=True)
def blind(kind: str = "drawn", first: int = 0, campaigns: int = 30, jobs: int = 2) -> None:
    """The commands on campaigns of drawn rigs, from a simulator that shares no code with the package."""
    seeds = range(first, first + campaigns)
    rows = run_chunks(f"blind-{kind}", partial(blind_chunk, kind), seeds, jobs)
    name = "blind" if kind == "drawn" else f"blind_{kind}"
    _write(f"{name}_campaigns", rows)
    _write(name, blind_table(rows))
    click.echo(blind_table(rows).to_string(index=False))


@studies.command()
@click.option("--results", default="results", type=click.Path(path_type=Path), show_default=True)
@click.option("--data", default="sample_data", type=click.Path(path_type=Path), show_default=True)
def lacking(results: Path, data: Path) -> None:
    """Hub loads of check runs by a model that lacks what the rig has, and by the closed one; after `make run`."""
    table = lacking_table(results, data)
    _write("lacking", table)
    click.echo(table.to_string(index=False))


def _attribution(kind: str, seed: int) -> pd.DataFrame:
    return attribution_chunk(case(kind, seed))


def _coverage(seed: int) -> pd.DataFrame:
    return coverage_chunk(load_geometry(GEOMETRY), CoverageTask(seed, FITS_PER_RIG))


def _maneuver(seed: int) -> pd.DataFrame:
    return maneuver_chunk(load_geometry(GEOMETRY), seed)


def _recovery(seed: int) -> pd.DataFrame:
    return recovery_chunk(load_geometry(GEOMETRY), seed)


def _write(name: str, table: pd.DataFrame) -> None:
    TABLES.mkdir(exist_ok=True)
    table.to_csv(TABLES / f"{name}.csv", index=False, float_format="%.6g")


if __name__ == "__main__":
    studies()
