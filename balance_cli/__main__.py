"""The program `balance`, also `python -m balance_cli`."""

import os
import sys

# With many small matrices BLAS threads cost more than they gain: up to ten times the run time on a busy machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from balance_cli.cli import balance

# [s]. With the default of 5 ms, threads that alternate short numpy calls wait for each other: 10 % of `diagnose`.
SWITCH_INTERVAL = 5e-4


def main() -> None:
    """Run the program with the arguments of the command line."""
    sys.setswitchinterval(SWITCH_INTERVAL)
    balance(prog_name="balance")


if __name__ == "__main__":
    main()
