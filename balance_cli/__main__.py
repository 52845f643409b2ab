"""The program `balance`, also `python -m balance_cli`."""

# Nothing that takes time is imported before the signals are handled: these modules are there when Python starts.
import _signal  # type: ignore[import-not-found]  # what `signal` wraps, without its enumerations
import gc
import os
import sys

# With many small matrices BLAS threads cost more than they gain: up to ten times the run time on a busy machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# The program shows no window; a backend for notebooks in the environment ends the import of matplotlib.
os.environ["MPLBACKEND"] = "agg"
# No plug-in of pydantic is used; the search for one reads the metadata of every package of the environment.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")

# [s]. With the default of 5 ms, threads that alternate short numpy calls wait for each other: 10 % of `diagnose`.
SWITCH_INTERVAL = 5e-4

# New objects between two searches for cycles among them. Those of imports stay; with the default of 700 these searches
# are a tenth of the start of a command.
OBJECTS_BETWEEN_SEARCHES = 50_000

# Options of mallopt(3) and their values: the largest block [bytes] that it allows, ten such blocks, one heap for all
# threads, as each heap of its own is returned whenever it is empty.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
LARGEST_KEPT_BLOCK, LARGEST_KEPT_TOTAL = 2**25, 10 * 2**25

SIGNALS = {"SIGINT": "interrupted", "SIGTERM": "terminated", "SIGHUP": "terminal closed"}
"""Signals that end the program, and the message of each. Not every system has SIGHUP."""
HELP_OPTIONS = {"-h", "--help", "-V", "--version"}
EXIT_INTERRUPTED = 130
"""128 and the number of SIGINT, as shells report it."""


def main() -> None:
    """Run the program with the arguments of the command line."""
    # Help writes no file: there Ctrl-C is an ordinary exception.
    handle = not HELP_OPTIONS & set(sys.argv[1:])
    _open_closed_streams()
    try:
        if handle:
            _handle_signals()
        gc.set_threshold(OBJECTS_BETWEEN_SEARCHES)
        from balance_cli.cli import balance

        sys.setswitchinterval(SWITCH_INTERVAL)
        _keep_freed_memory()
        _silence_libraries()
        balance(prog_name="balance")
    except SystemExit as end:
        if handle and isinstance(end.code, int) and end.code:
            _end_process(end.code)
        raise
    except KeyboardInterrupt:
        _write_line("interrupted, nothing written")
        sys.exit(EXIT_INTERRUPTED)
    finally:
        if handle:
            _ignore_signals()  # the exit status is fixed


def _open_closed_streams() -> None:
    """Open the null device for each standard stream that is closed.

    Otherwise the next file that is opened gets its number, and messages are written into it.
    """
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", errors="backslashreplace", closefd=False))


def _keep_freed_memory() -> None:
    """Let the C library keep freed blocks for the next arrays, where it is the one of GNU.

    Otherwise it returns each large block to the system, which fills the pages of the next one with zeros anew: a tenth
    of the time of a fit.
    """
    import ctypes

    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # no such function; on Windows no such library
        return
    mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT_BLOCK)
    mallopt(M_TRIM_THRESHOLD, LARGEST_KEPT_TOTAL)
    mallopt(M_ARENA_MAX, 1)


def _silence_libraries() -> None:
    """Leave the warnings of libraries to `--verbose` and to Python's own option `-W`: they name no file of the user."""
    import warnings

    if not sys.warnoptions and not {"-v", "--verbose"} & set(sys.argv[1:]):
        warnings.simplefilter("ignore")


def _end_process(status: int) -> None:
    """End a process that failed, without the clean-up of extension modules.

    At the end of the interpreter HDF5 once more closes the files that it could not write, and crashes.
    """
    _ignore_signals()
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            continue
    os._exit(status)


def _handle_signals() -> None:
    """Let the signals end the program in order, except those that the caller ignores (as `nohup` does)."""
    for number in _signal_numbers():
        if _signal.getsignal(number) is not _signal.SIG_IGN:
            _signal.signal(number, _exit_on_signal)


def _ignore_signals() -> None:
    for number in _signal_numbers():
        _signal.signal(number, _signal.SIG_IGN)


def _signal_numbers() -> dict[int, str]:
    """The message of each signal that this system has."""
    return {getattr(_signal, name): message for name, message in SIGNALS.items() if hasattr(_signal, name)}


def _exit_on_signal(number: int, _frame: object) -> None:
    """Remove the staged files, print one line and end the process with status 128 + number.

    An exception would not do: extension modules that are being imported replace it by their own or drop it, and a pool
    of threads waits for its work.
    """
    # No file is staged before this module is imported; it may be half imported now.
    abandon = getattr(sys.modules.get("balance_cli.io.atomic"), "abandon_outputs", None)
    outcome = abandon(lambda: _exit_on_signal(number, None)) if abandon else "nothing written"
    if outcome is None:
        return
    _ignore_signals()
    describe_kept = getattr(sys.modules.get("balance_cli.cli.batch.journal"), "describe_kept_results", None)
    kept = describe_kept() if describe_kept else ""
    _write_line(f"{_signal_numbers()[number]}, {outcome}{kept and f'; {kept}'}")
    os._exit(128 + number)


def _write_line(message: str) -> None:
    """Print the message on stderr; on a terminal it begins below a progress bar or an echoed ^C."""
    start = "\n" if os.isatty(2) else ""
    try:
        os.write(2, f"{start}balance: error: {message}\n".encode())
    except OSError:
        return  # the terminal may be gone


if __name__ == "__main__":
    main()
