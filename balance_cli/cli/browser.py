"""Browsers: a PDF of a page by Chromium without a window, and showing a page to the user."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import webbrowser
from pathlib import Path

from balance_cli.io.errors import UserError
from balance_cli.io.text_output import write_text

CHROMIUM_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "microsoft-edge")
LONGEST_PRINT = 180.0
"""Seconds after which printing is given up; a page of 5 MB takes about ten."""


def find_chromium() -> str | None:
    """Return the path of a browser of the Chromium family, None where there is none."""
    return next((path for name in CHROMIUM_NAMES if (path := shutil.which(name))), None)


def print_pdf(html: str) -> bytes:
    """Print a page to a PDF.

    Raises UserError where no browser is installed, or where it does not print.
    """
    browser = find_chromium()
    if browser is None:
        remedy = "Install Chromium, or open the page in a browser and print it there"
        raise UserError("printing needs Chromium or Chrome, and none is on the path", "--pdf", remedy=remedy)
    with tempfile.TemporaryDirectory() as folder:
        page, pdf = Path(folder, "page.html"), Path(folder, "page.pdf")
        write_text(page, html)
        words = [browser, "--headless", "--disable-gpu", "--no-pdf-header-footer", f"--user-data-dir={folder}/profile"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            words.append("--no-sandbox")  # Chromium refuses to start its sandbox as root
        try:
            process = subprocess.run(
                [*words, f"--print-to-pdf={pdf}", page.as_uri()],
                capture_output=True,
                timeout=LONGEST_PRINT,
                check=False,
            )
            message = process.stderr.decode(errors="replace").strip().splitlines()[-1:]
        except (OSError, subprocess.TimeoutExpired) as error:
            message = [str(error)]
        if not pdf.is_file():
            remedy = "Open the page in a browser and print it there"
            raise UserError(
                f"{browser} did not print the page: {' '.join(message) or 'no message'}", "--pdf", remedy=remedy
            )
        return pdf.read_bytes()


def show_page(path: Path) -> None:
    """Show a page in the user's browser, where there are both."""
    if path.is_file():
        webbrowser.open(path.resolve().as_uri())
