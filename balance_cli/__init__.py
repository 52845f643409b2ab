"""Data reduction for a six-component rotor balance, from raw volts to rotor-harmonic hub loads.

The names below are the public interface; `docs/api.md` shows how they work together. Each one is imported when it is
first used, so that `import balance_cli` alone is fast.
"""

from __future__ import annotations

TYPE_CHECKING = False
"""As in `typing`, which is not imported: until the program handles signals, an interrupt would be a traceback."""

if TYPE_CHECKING:
    from typing import Any

    from balance_cli.api.analysis import calibrate as calibrate
    from balance_cli.api.analysis import frequency_response as frequency_response
    from balance_cli.api.analysis import identify as identify
    from balance_cli.api.artefacts import load_artefact as load_artefact
    from balance_cli.api.artefacts import save_artefact as save_artefact
    from balance_cli.api.diagnosis import diagnose as diagnose
    from balance_cli.api.inputs import read_geometry as read_geometry
    from balance_cli.api.inputs import read_run as read_run
    from balance_cli.api.reduction import reduce as reduce
    from balance_cli.api.simulation import simulate as simulate
    from balance_cli.io.errors import UserError as UserError
    from balance_cli.io.version import __version__ as __version__

_MODULE_OF = {
    "UserError": "balance_cli.io.errors",
    "__version__": "balance_cli.io.version",
    "calibrate": "balance_cli.api.analysis",
    "diagnose": "balance_cli.api.diagnosis",
    "frequency_response": "balance_cli.api.analysis",
    "identify": "balance_cli.api.analysis",
    "load_artefact": "balance_cli.api.artefacts",
    "read_geometry": "balance_cli.api.inputs",
    "read_run": "balance_cli.api.inputs",
    "reduce": "balance_cli.api.reduction",
    "save_artefact": "balance_cli.api.artefacts",
    "simulate": "balance_cli.api.simulation",
}
"""Where each public name is defined."""

__all__ = [
    "UserError",
    "calibrate",
    "diagnose",
    "frequency_response",
    "identify",
    "load_artefact",
    "read_geometry",
    "read_run",
    "reduce",
    "save_artefact",
    "simulate",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used (PEP 562)."""
    from importlib import import_module

    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULE_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
