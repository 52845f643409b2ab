"""The program `balance`, also `python -m balance_cli`."""

import os

# The matrices here are many and small: threads in BLAS cost more than they bring, tenfold on a busy machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from balance_cli.cli import balance


def main() -> None:
    """Run the program on the words of the command line."""
    balance(prog_name="balance")


if __name__ == "__main__":
    main()
