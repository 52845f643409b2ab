"""Results of a batch in the order of its items, few of which are in work at a time; a worker may be lost."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

from balance_cli.cli.batch.executors import Workers
from balance_cli.io.errors import UserError

T = TypeVar("T")
R = TypeVar("R")

ATTEMPTS = 2
"""Times that an item may end a worker in which it is alone: once may be the lack of memory of a busy machine."""


class WorkerPool:
    """An executor that is opened again where a worker was lost."""

    def __init__(self, workers: Workers) -> None:
        self._workers = workers
        self._executor: Executor | None = None

    def results(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[T, R | UserError]]:
        """Yield each item with `function(item)`, or with the UserError that it raised, in the order of the items.

        Whatever their number, no more than a window of them is submitted, so that memory stays bounded. Where a worker
        is lost, the items in work are repeated one at a time; one that ends its worker again and again has an error.
        """
        rest = iter(items)
        pending: deque[tuple[T, Future[R]]] = deque()
        while True:
            for item in rest:
                pending.append((item, self._submit(function, item)))
                if len(pending) >= self._workers.window:
                    break
            if not pending:
                return
            item, future = pending.popleft()
            try:
                outcome: R | UserError = _outcome(future)
            except self._workers.lost:
                yield item, self._repeat(function, item)
                lost = [(item, future) for item, future in pending if not _is_sound(future)]
                pending = deque(
                    (item, _done(self._repeat(function, item)) if (item, future) in lost else future)
                    for item, future in pending
                )
            else:
                yield item, outcome

    def close(self) -> None:
        """End the workers; what was submitted and not begun is dropped."""
        if self._executor is not None:
            self._executor.shutdown(wait=True, **self._workers.shutdown_options)
            self._executor = None

    def _submit(self, function: Callable[[T], R], item: T) -> Future[R]:
        try:
            return self._open().submit(function, item)
        except self._workers.lost:  # while the pool was idle
            self._reopen()
            return self._open().submit(function, item)

    def _repeat(self, function: Callable[[T], R], item: T) -> R | UserError:
        """Return the result of an item that is in work alone; one that ends its worker ATTEMPTS times has an error.

        How its worker ended before does not count: all items in work are lost where one of them ends a worker.
        """
        for _ in range(ATTEMPTS):
            self._reopen()
            with suppress(*self._workers.lost):
                return _outcome(self._submit(function, item))
        self._reopen()
        fault = "the process that reduced it ended twice without a result (no memory?)"
        return UserError(fault, str(getattr(item, "path", item)), remedy="Give it alone, with --jobs 1")

    def _open(self) -> Executor:
        if self._executor is None:
            self._executor = self._workers.open()
        return self._executor

    def _reopen(self) -> None:
        executor, self._executor = self._executor, None
        if executor is not None:
            executor.shutdown(wait=False, **self._workers.shutdown_options)


@contextmanager
def worker_pool(workers: Workers) -> Iterator[WorkerPool]:
    """Yield a pool of these workers, which end with the block."""
    pool = WorkerPool(workers)
    try:
        yield pool
    finally:
        pool.close()


def _outcome(future: Future[R]) -> R | UserError:
    try:
        return future.result()
    except UserError as error:
        return error


def _is_sound(future: Future[Any]) -> bool:
    """Whether a call ended by itself, before the worker was lost."""
    return future.done() and not future.cancelled() and isinstance(future.exception(), UserError | None)


def _done(outcome: R | UserError) -> Future[R]:
    future: Future[R] = Future()
    if isinstance(outcome, UserError):
        future.set_exception(outcome)
    else:
        future.set_result(outcome)
    return future
