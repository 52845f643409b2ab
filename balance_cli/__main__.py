"""The program `balance`, also `python -m balance_cli`."""

from balance_cli.cli import balance


def main() -> None:
    """Run the program on the words of the command line."""
    balance(prog_name="balance")


if __name__ == "__main__":
    main()
