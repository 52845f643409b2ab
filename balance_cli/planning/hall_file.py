"""Hall files in YAML: all faults named by file, place and remedy."""

from __future__ import annotations

from pathlib import Path

from pydantic import ValidationError

from balance_cli.io.errors import UserError
from balance_cli.io.formats import HALL_FORMAT
from balance_cli.io.sniff import describe_file, require_file, sniff_format
from balance_cli.io.validation import validation_faults
from balance_cli.io.yaml_file import read_yaml
from balance_cli.planning.hall import Hall


def load_hall(path: Path) -> Hall:
    """The hall declared in a YAML file. Raises UserError for its first fault."""
    try:
        require_file(path)
        if not path.is_file():
            raise UserError(f"is {describe_file(path)}, where a hall was expected", remedy="Give a YAML file")
        declared = read_yaml(path, "a hall")
        if not isinstance(declared, dict):
            raise UserError("holds no keys", remedy=f"Begin it with `format: {HALL_FORMAT}`")
        if declared.get("format") != HALL_FORMAT and sniff_format(path) is not None:
            raise UserError(f"is {describe_file(path)}, where a hall was expected", remedy="Give the file of a hall")
        try:
            return Hall.model_validate(declared)
        except ValidationError as error:
            raise validation_faults(Hall, error)[0] from error
    except UserError as error:
        raise error.with_location(file=str(path)) from error
