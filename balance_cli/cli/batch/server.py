"""Imported by the server that forks the workers of a batch, and by nothing else.

A command that a signal ends, or that is killed, leaves the folder with the socket of this server. The server ends after
the command and its workers, so it removes the folder.
"""

import atexit
import os
import shutil

import balance_cli.cli.batch.work  # noqa: F401  # so that a worker starts in milliseconds
from balance_cli.cli.batch.executors import SERVER_FOLDER_VARIABLE


def _remove_folder(folder: str, owner: int) -> None:
    if os.getpid() == owner:  # not in a worker
        shutil.rmtree(folder, ignore_errors=True)


if SERVER_FOLDER_VARIABLE in os.environ:
    atexit.register(_remove_folder, os.environ[SERVER_FOLDER_VARIABLE], os.getpid())
