"""The program `balance`, also `python -m balance_cli`."""

import os
import sys

# The matrices here are many and small: threads in BLAS cost more than they bring, tenfold on a busy machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from balance_cli.cli import balance

# Two threads that share many short calls of numpy else wait for each other: a tenth of a diagnosis.
SWITCH_INTERVAL = 5e-4


def main() -> None:
    """Run the program on the words of the command line."""
    sys.setswitchinterval(SWITCH_INTERVAL)
    balance(prog_name="balance")


if __name__ == "__main__":
    main()
