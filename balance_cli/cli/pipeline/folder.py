"""The results folder of a chain: one process at a time works in it, and it lists its inputs."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from balance_cli.campaign.rig.components import RUN_KINDS
from balance_cli.cli.pipeline.inventory import Inventory
from balance_cli.cli.pipeline.state import STATE_NAME, State
from balance_cli.cli.pipeline.steps import Plan
from balance_cli.io.atomic import atomic_write, os_errors_as_user_error
from balance_cli.io.errors import UserError

INPUT_LIST = "inputs.txt"
LOGS = "logs"
"""Folder of the messages of each step. A step without a file in it has not been started in this folder."""


def log_path(folder: Path, step: str) -> Path:
    """Return the file with the messages of a step, which is there from its start."""
    return folder / LOGS / f"{step}.txt"


def require_absent(paths: Iterable[Path], command: str) -> None:
    """Raise UserError where one of these files is there: this command would replace it without having written it."""
    for path in paths:
        if path.exists():
            fault = f"is there, and no earlier `balance {command}` has written it: it would be replaced"
            raise UserError(fault, str(path), remedy="Move it away, or give another folder for the results")


def require_own_results(folder: Path, plan: Plan, state: State) -> None:
    """Raise UserError where a file that the chain would write is there, but no earlier call has written it."""
    targets = [] if state.steps or (folder / LOGS).is_dir() else [folder / INPUT_LIST, folder / STATE_NAME]
    for step in plan.steps:
        if step.name not in state.steps and not log_path(folder, step.name).exists():
            targets += [*step.writes, *(path for inner in step.writes_in for path in inner.glob("*.h5"))]
    require_absent(targets, "run")


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Create the folder if necessary and hold it. Raises UserError where another process works in it.

    The lock is on the subfolder of the logs: the steps themselves lock the folder when they move their outputs into
    it. It ends with the process. Where the file system has no locks, none is held.
    """
    with os_errors_as_user_error(folder):
        (folder / LOGS).mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / LOGS, os.O_RDONLY)
    try:
        with suppress(ImportError):
            _lock(descriptor, folder)
        yield
    finally:
        os.close(descriptor)


def _lock(descriptor: int, folder: Path) -> None:
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        fault = "another `balance run` works in this folder"
        raise UserError(fault, str(folder), remedy="Wait for its end, or give another folder") from error
    except OSError:
        pass  # no locks on this file system


def write_input_list(folder: Path, inventory: Inventory) -> None:
    """Write the names of geometry and runs, one a line."""
    paths = [inventory.geometry_path, *(run.path for run in inventory.of_kind(*RUN_KINDS))]
    with atomic_write(folder / INPUT_LIST) as part:
        part.write_bytes(b"".join(os.fsencode(path) + b"\n" for path in paths))
