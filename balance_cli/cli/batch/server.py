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


def remove_folder_at_end(started_by: int, folder: str) -> bool:
    """Let this process remove the folder when it ends, unless it is the command itself, which does so anyway."""
    if started_by == os.getpid():
        return False
    atexit.register(_remove_folder, folder, os.getpid())
    return True


if SERVER_FOLDER_VARIABLE in os.environ:
    command, _, name = os.environ[SERVER_FOLDER_VARIABLE].partition(" ")
    remove_folder_at_end(int(command), name)
