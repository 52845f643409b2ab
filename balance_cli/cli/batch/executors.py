"""Where the runs of a batch are reduced: in this process, in processes of this machine, or on a Dask cluster.

All three are `concurrent.futures.Executor`. Results do not depend on which is used: BLAS has one thread everywhere, so
that sums have the same order.
"""

from __future__ import annotations

import ctypes
import importlib
import multiprocessing
import multiprocessing.util
import os
import signal
import sys
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from typing import Any, ParamSpec, TypeVar

from balance_cli.io.errors import UserError
from balance_cli.io.reader_process import reader_process

P = ParamSpec("P")
T = TypeVar("T")

DASK_SCHEME = "dask://"
THREAD_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
SERVER_MODULE = "balance_cli.cli.batch.server"
"""Imported once, by the server that forks the workers."""
SERVER_FOLDER_VARIABLE = "BALANCE_WORKER_FOLDER"
"""Environment variable that tells the server which process started it, and the folder to remove."""
NO_TRACKER_WARNING = "ignore:resource_tracker:UserWarning"
"""Option `-W` of the process that frees semaphores: it need not tell the user of a command that a signal ended."""
KEPT_MEMORY = 2**28
"""Bytes of freed memory that a process keeps for the next run. By default the C library of Linux returns arrays of a
megabyte to the system and clears them anew: a fifth of the time of a run."""
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of `mallopt` in glibc's <malloc.h>."""
LARGEST_HEAP_ARRAY = 2**25
"""Bytes of an array that glibc may take from the heap, its upper bound of that threshold on 64-bit systems."""
DASK_CONNECTION_TIME = 10.0
"""[s] after which a scheduler that does not answer is reported."""


@dataclass(frozen=True)
class Workers:
    """How to open an executor; `window` runs are submitted at a time.

    `lost` are the exceptions of an executor that lost a worker; `shutdown_options`: beyond those that every executor
    has.
    """

    open: Callable[[], Executor]
    window: int
    lost: tuple[type[BaseException], ...] = (BrokenExecutor,)
    shutdown_options: Mapping[str, bool] = field(default_factory=lambda: {"cancel_futures": True})


class InlineExecutor(Executor):
    """Runs each call at once, in this process."""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Run the call, and return a future that is done."""
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def batch_workers(jobs: int, address: str | None) -> Workers:
    """Return the workers that the options ask for.

    Raises UserError for an address that is not `dask://HOST:PORT`, and where Dask is not installed.
    """
    if address is not None:
        return _dask_workers(address)
    if jobs == 1:
        keep_freed_memory()
        return Workers(InlineExecutor, 1)
    # Twice as many as workers: one is in work, and the next is there when it ends.
    return Workers(lambda: _process_pool(jobs), 2 * jobs)


def _process_pool(jobs: int) -> ProcessPoolExecutor:
    """Processes that are started afresh: a fork of this process would inherit its threads and its BLAS."""
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    if "forkserver" not in multiprocessing.get_all_start_methods():
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(jobs, context, initializer=_start_worker)
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload([SERVER_MODULE])
    os.environ[SERVER_FOLDER_VARIABLE] = f"{os.getpid()} {multiprocessing.util.get_temp_dir()}"
    if NO_TRACKER_WARNING not in sys.warnoptions:
        sys.warnoptions.append(NO_TRACKER_WARNING)
    return ProcessPoolExecutor(jobs, server, initializer=_start_worker)


def keep_freed_memory() -> None:
    """Let this process keep the memory of a run for the next one, where the C library is glibc."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    mallopt(M_MMAP_THRESHOLD, LARGEST_HEAP_ARRAY)
    mallopt(M_TRIM_THRESHOLD, KEPT_MEMORY)


def _start_worker() -> None:
    """Leave signals of the terminal to the parent, end with it, and read files in a child of this worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    keep_freed_memory()
    reader_process().__enter__()  # it lasts as long as the worker
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this worker when its parent was killed: nobody else would tell it."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _dask_workers(address: str) -> Workers:
    host = address.removeprefix(DASK_SCHEME)
    if not address.startswith(DASK_SCHEME) or ":" not in host:
        fault = f"`{address}` is not the address of a Dask scheduler"
        raise UserError(fault, "--executor", remedy=f"Write {DASK_SCHEME}HOST:PORT")
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError:
        remedy = "Install it: pip install 'balance-cli[dask]'"
        raise UserError("Dask is not installed", "--executor", remedy=remedy) from None
    client: list[Any] = []

    def open_executor() -> Executor:
        with suppress(IndexError):
            client.pop().close()
        try:
            client.append(distributed.Client(f"tcp://{host}", timeout=DASK_CONNECTION_TIME, set_as_default=False))
        except (OSError, TimeoutError) as error:
            remedy = "Start it (`dask scheduler`, `dask worker`), or correct the address"
            raise UserError(f"no Dask scheduler answers at {host}", "--executor", remedy=remedy) from error
        executor: Executor = client[0].get_executor(pure=False)
        return executor

    return Workers(open_executor, 64, (BrokenExecutor, distributed.KilledWorker), {})
