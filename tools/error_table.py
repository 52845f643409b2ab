"""Errors of the hub loads on the check runs of the sample campaign, for the README (`make figures`).

    python tools/error_table.py RESULTS

Reads `loads-*.h5` in a folder of results, stores the errors in `docs/pictures/check-errors.json`, and writes the table
between the marks in the README.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping
from pathlib import Path

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.io.artefacts import load_artefact
from balance_cli.io.formats import LOADS_FORMAT
from balance_cli.reduction.result import HubLoads
from balance_cli.report.check_errors import pooled_errors

ROOT = Path(__file__).parents[1]
STORED = ROOT / "docs" / "pictures" / "check-errors.json"
README = ROOT / "README.md"
METHODS = {
    "static": "static matrix",
    "computed": "computed model",
    "rigid": "rigid model, identified",
    "paper": "paper's form, diagonal damping",
    "paper-full": "paper's form, full damping",
    "transfer": "measured response",
    "closed": "**model updated by `diagnose`**",
}
NOISE_FLOOR = "noise floor"
BLOCK = re.compile(r"(?<=<!-- errors -->\n).*?(?=<!-- end of errors -->)", re.DOTALL)

Errors = Mapping[str, Mapping[str, float]]


def errors_of(results: Path) -> dict[str, dict[str, float]]:
    """{method: {component: error in % of the applied load}}, and the noise floor of the updated model."""
    errors = {}
    for method in METHODS:
        content = load_artefact(results / f"loads-{method}.h5", {LOADS_FORMAT: HubLoads}).content
        pooled = pooled_errors(content, "load_error")
        errors[method] = {name: float(f"{100 * error.value:.3g}") for name, error in pooled.items()}
        errors[NOISE_FLOOR] = {name: float(f"{100 * error.noise:.3g}") for name, error in pooled.items()}
    return errors


def table(errors: Errors) -> str:
    """The table of the README: one row for each method, two digits."""
    head = f"| error in % of the applied load | {' | '.join(COMPONENTS)} |\n|---|{'---|' * len(COMPONENTS)}\n"
    labels = {**METHODS, NOISE_FLOOR: NOISE_FLOOR}
    return head + "".join(
        f"| {label} | {' | '.join(_two_digits(errors[method][name]) for name in COMPONENTS)} |\n"
        for method, label in labels.items()
    )


def _two_digits(percent: float) -> str:
    return f"{float(f'{percent:.2g}'):.0f}" if percent >= 10 else f"{percent:#.2g}"


def main(results: Path) -> None:
    """Store the errors of a folder of results, and write the table."""
    errors = errors_of(results)
    STORED.write_text(json.dumps(errors, indent=2) + "\n", encoding="utf-8")
    README.write_text(BLOCK.sub(lambda _: table(errors), README.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
