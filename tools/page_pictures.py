"""Take the screenshots of the page in docs/pictures, in a headless Chromium: `make figures`."""

from __future__ import annotations

import io
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

from balance_cli.cli.browser import find_chromium

FOLDER = Path(__file__).parents[1] / "docs" / "pictures"
COLORS = 64
"""Colors of a picture: pages have few, and the files stay small."""


def main(page: Path) -> None:
    """Write page-first.png, page-bode.png, page-azimuth.png and page-phone.png from a page."""
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=find_chromium(), args=["--no-sandbox"])
        wide = browser.new_page(viewport={"width": 1280, "height": 800})
        wide.goto(page.absolute().as_uri())
        save(wide.screenshot(), "page-first.png")
        chart(wide, "azimuth", "page-azimuth.png")
        chart(wide, "fit", "page-bode.png", "v.setScale('x', {min: 15, max: 75})")
        phone = browser.new_page(viewport={"width": 390, "height": 844}, color_scheme="dark")
        phone.goto(page.absolute().as_uri())
        save(phone.screenshot(), "page-phone.png")
        browser.close()


def chart(tab: Page, name: str, file: str, zoom: str = "") -> None:
    """Save one chart, zoomed by an expression on its first plot `v`."""
    figure = tab.locator(f"#picture-{name}")
    figure.scroll_into_view_if_needed()
    tab.wait_for_selector(f"#picture-{name} .u-legend")
    if zoom:
        tab.evaluate(
            f"() => {{ const v = balanceCharts.find(c => c.figure.id === 'picture-{name}').views[0]; {zoom}; }}"
        )
    tab.wait_for_timeout(500)
    save(figure.screenshot(), file)


def save(png: bytes, file: str) -> None:
    """Save a screenshot with few colors."""
    with Image.open(io.BytesIO(png)) as image:
        reduced = image.convert("RGB").quantize(COLORS, dither=Image.Dither.NONE)
        reduced.save(FOLDER / file, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
