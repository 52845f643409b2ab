"""One picture of the page as an SVG file of its own."""

from __future__ import annotations

from balance_cli.report.blocks import Chart, Picture
from balance_cli.report.static_plot import plots_svg


def picture_svg(block: Picture | Chart) -> str:
    """Return the picture as an SVG document; of a chart, its static picture."""
    if isinstance(block, Picture):
        return block.markup + "\n"
    return block.static_markup + "\n" if block.static_markup else plots_svg(block.groups[0].plots)
