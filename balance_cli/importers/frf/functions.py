"""What every format gives of measured frequency responses: functions of one response over one reference."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Terminal:
    """The response or the reference of a function, as the file calls it.

    `names` are those by which a map may call it, the longest first. `direction` is that of the file (`+Z`, `-Z`), empty
    where it states none. `quantity` is what was measured (`an acceleration`), empty where the file leaves it open, and
    `unit` is empty where the file states none.
    """

    names: tuple[str, ...]
    unit: str = ""
    quantity: str = ""
    direction: str = ""

    @property
    def name(self) -> str:
        """What messages call it."""
        return self.names[0]


@dataclass(frozen=True)
class FrfFunction:
    """Values (k,) of a response over a reference at `frequency` (k,) [Hz], with the phase of the file.

    `resolution` is the relative rounding of the stored numbers, `place` where they are in the file.
    """

    response: Terminal
    reference: Terminal
    frequency: Array
    value: ComplexArray
    resolution: float
    place: str


@dataclass(frozen=True)
class CoherenceFunction:
    """Ordinary coherence (k,) of a response with a reference at `frequency` (k,) [Hz]."""

    response: Terminal
    reference: Terminal
    frequency: Array
    value: Array
    place: str


@dataclass(frozen=True)
class FrfFile:
    """The frequency responses of a file, and `notes` on what of it was not used."""

    path: Path
    format: str
    functions: tuple[FrfFunction, ...]
    coherences: tuple[CoherenceFunction, ...] = ()
    notes: tuple[str, ...] = ()
