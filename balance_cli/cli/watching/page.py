"""The page of a watched folder: the newest runs, shown again by the browser when the page has changed."""

from __future__ import annotations

from pathlib import Path

from balance_cli.cli.watching.quick_look import QuickLook
from balance_cli.io.artefacts import Artefact, content_digest
from balance_cli.io.atomic import atomic_write
from balance_cli.io.formats import LOADS_FORMAT
from balance_cli.io.text_output import write_text

# A page in a browser cannot look at its own file; it is loaded again, but not while somebody works with it.
RELOAD_SCRIPT = """<script>
(() => {
  let used = Date.now();
  for (const kind of ["pointerdown", "pointermove", "keydown", "wheel", "touchstart"])
    addEventListener(kind, () => { used = Date.now(); }, { passive: true });
  setInterval(() => { if (Date.now() - used > 8000) location.reload(); }, 4000);
})();
</script>
"""


def write_page(path: Path, quick_look: QuickLook, most_runs: int) -> None:
    """Write the page with the newest runs, the newest first."""
    from balance_cli.report.page import build_page
    from balance_cli.report.sources import group_sources

    loads = quick_look.hub_loads(list(quick_look.runs)[: -most_runs - 1 : -1])
    provenance = quick_look.provenance()
    artefact = Artefact(LOADS_FORMAT, loads, provenance, content_digest(LOADS_FORMAT, loads, provenance))
    html = build_page(group_sources([(path.with_name("loads.h5"), artefact)])).html
    with atomic_write(path) as part:
        write_text(part, html.replace("</body>", RELOAD_SCRIPT + "</body>"))
