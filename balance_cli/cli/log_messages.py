"""Log messages of the package on stderr while a command runs."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from balance_cli.cli.labels import echo_message


class _StderrHandler(logging.Handler):
    """Prints the messages of the log as the session prints its own."""

    def emit(self, record: logging.LogRecord) -> None:
        echo_message(record.levelname.lower(), self.format(record))


@contextmanager
def log_to_stderr(verbose: bool) -> Iterator[None]:
    """Show the warnings of the package's log; with `verbose`, all messages and Python's own warnings too."""
    loggers = [logging.getLogger("balance_cli"), *([logging.getLogger("py.warnings")] if verbose else [])]
    handler = _StderrHandler()
    logging.captureWarnings(verbose)
    for logger in loggers:
        logger.addHandler(handler)
        logger.setLevel(logging.DEBUG if verbose else logging.WARNING)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeHandler(handler)
        logging.captureWarnings(False)
