"""Names that the user of a reduction chooses from."""

import subprocess
import sys

from balance_cli.reduction.choices import LOAD_MODEL_TEXTS, LOAD_MODELS


def test_choices_are_those_of_the_code_behind_them():
    assert tuple(LOAD_MODEL_TEXTS) == LOAD_MODELS


def test_choices_import_nothing_heavy():
    code = "import sys, balance_cli.reduction.choices; print('numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
