"""The options `--terms` and `--significance` of `balance calibrate`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from balance_cli.cli.common import Session
from balance_cli.cli.options import NumberRange, WordOrFile
from balance_cli.io.errors import UserError

if TYPE_CHECKING:
    from balance_cli.calibration.term_choice import TermChoice
    from balance_cli.campaign.rig.geometry import Geometry

F = TypeVar("F", bound=Callable[..., Any])
KINDS = ("search", "linear", "quadratic")

terms_option: Callable[[F], F] = click.option(
    "--terms",
    type=WordOrFile(),
    metavar="search|linear|quadratic|LIST|FILE",
    default="search",
    show_default=True,
    help="Terms of the model of all trims: those that a search selects for each channel, the loads alone, all squares "
    "and products, a list such as `Fx^2,Fx Fy,|Mz|`, or a file with one term a line, `CHANNEL: TERM, TERM` for one "
    "channel (YAML is read, too). An earlier calibration, or a matrix as `--matrix` writes it (.csv), gives its terms "
    "by channel.",
)
significance_option: Callable[[F], F] = click.option(
    "--significance",
    type=NumberRange(0.0, 1.0, min_open=True, max_open=True),
    metavar="P",
    help="Probability of any spurious term in the balance, for `--terms search`. Default: 0.01.",
)


def term_choice(session: Session, terms: str, significance: float | None, geometry: Geometry) -> TermChoice:
    """The terms that the options ask for; a file is recorded as an input.

    Raises UserError for an unknown term or channel, a list without terms, and a level without a search.
    """
    from balance_cli.calibration.term_choice import TERM_SIGNIFICANCE_LEVEL, choice_of_words, require_known_names
    from balance_cli.campaign.rig.load_components import load_components

    if significance is not None and terms != "search":
        fault = "a significance level without a search for terms"
        raise UserError(fault, "--significance", remedy="Leave it out, or give --terms search")
    is_file = terms not in KINDS and Path(terms).is_file()
    level = TERM_SIGNIFICANCE_LEVEL if significance is None else significance
    components = load_components(geometry).names
    choice = _read_choice(session, Path(terms), components) if is_file else choice_of_words(terms, level)
    try:
        require_known_names(choice, geometry.channel_names, components, terms if is_file else "")
    except UserError as error:
        if is_file or not _looks_like_path(terms):
            raise
        fault = "is no file, and no term either"
        remedy = f"Give search, linear, quadratic, a file, or terms. {error.remedy}"
        raise UserError(fault, terms, "--terms", remedy) from None
    return choice


def _looks_like_path(text: str) -> bool:
    return "," not in text and (bool(Path(text).suffix) or "/" in text)


def _read_choice(session: Session, path: Path, components: Sequence[str]) -> TermChoice:
    from balance_cli.calibration.matrix import model_from_matrix
    from balance_cli.calibration.matrix_file import read_matrix_file, read_text_file
    from balance_cli.calibration.result import Calibration
    from balance_cli.calibration.term_choice import choice_of_lines, choice_of_model
    from balance_cli.io.formats import CALIBRATION_FORMAT, MATRIX_FORMAT
    from balance_cli.io.sniff import is_hdf5

    if is_hdf5(path):
        earlier = session.artefact(path, {CALIBRATION_FORMAT: Calibration}, "terms").content
        if earlier.all_trims is None:
            raise UserError("has no calibration model of all trims", str(path), "--terms", "Give another calibration")
        return choice_of_model(earlier.all_trims.model)
    text, digest = read_text_file(path, "a list of terms", "Give a text file with one term a line")
    if text.startswith(MATRIX_FORMAT.partition("/")[0]):
        choice = choice_of_model(model_from_matrix(read_matrix_file(path)[0].matrix))
    else:
        choice = choice_of_lines(text.removeprefix("\ufeff").splitlines(), str(path), components)
    session.record_input(path.name, "terms", digest)
    return choice
