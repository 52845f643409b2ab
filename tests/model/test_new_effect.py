"""The manual's page on a new effect shows an effect of the library as it is."""

import inspect
import re
from pathlib import Path

from balance_cli.model.effects import cell_dashpot
from balance_cli.simulation.extensions.cells import CellDashpot

PAGE = Path(__file__).parents[2] / "docs" / "new-effect.md"


def test_the_code_of_the_page_is_that_of_the_library():
    effect, extension = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert effect == inspect.getsource(cell_dashpot)
    assert extension == inspect.getsource(CellDashpot)
