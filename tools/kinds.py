"""Sort the runs of a campaign by kind for its pipeline, from the summary of `balance check --json`.

Writes `kinds.mk` with the make variables STATIC, SWEEP, CHECK, WIND and ZERO. Beside it, one list per kind (and one for
the geometry) holds the digest of every file and is rewritten only where it changes. Each step depends on the lists of
the files that it uses, so that it runs again when their content changes, whatever the modification times.
"""

import json
import sys
from pathlib import Path

KINDS = ("static", "sweep", "check", "wind", "zero")


def main(summary: Path) -> None:
    """Write the variables and the lists into the folder of the summary."""
    files = json.loads(summary.read_text(encoding="utf-8"))["files"]
    digests = {kind: {} for kind in (*KINDS, "geometry")}
    for path, about in files.items():
        kind = about.get("run_kind") or about["kind"]
        if kind in digests:
            digests[kind][path] = about["digest"]
    for kind, members in digests.items():
        text = "".join(f"{digest}  {Path(path).name}\n" for path, digest in members.items())
        _write_if_changed(summary.with_name(f"{kind}.list"), text)
    variables = [f"{kind.upper()} := {' '.join(digests[kind])}\n" for kind in KINDS]
    summary.with_name("kinds.mk").write_text("".join(variables), encoding="utf-8")


def _write_if_changed(path: Path, text: str) -> None:
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
