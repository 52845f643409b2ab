"""`balance modes`: computed natural frequencies, shapes, and their sensitivity to each stiffness."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.options import geometry_option

if TYPE_CHECKING:
    from balance_cli.steps.modes import ComputedModes


@balance_command("modes")
@geometry_option
def command(session: Session, geometry: Path) -> None:
    """Compute eigenfrequencies, mode shapes, and their sensitivity.

    Sensitivity is the change of an eigenfrequency with the stiffness of each cell.
    """
    from balance_cli.model.balance import check_effects
    from balance_cli.steps.modes import computed_modes

    rig = session.geometry(geometry)
    check_effects(rig, str(geometry))
    computed = computed_modes(rig)
    session.finish(_summary(computed), _text(computed))


def _summary(computed: ComputedModes) -> dict[str, Any]:
    table = computed.modes
    return {
        "coordinates": table.coordinates,
        "modes": [
            {
                "frequency_hz": table.frequency[i],
                "damping_ratio": table.damping_ratio[i],
                "sigma_frequency_hz": table.sigma_frequency[i],
                "sigma_damping_ratio": table.sigma_damping_ratio[i],
                "shape_real": table.shape[i].real,
                "shape_imag": table.shape[i].imag,
                "sensitivity": dict(zip(computed.stiffnesses, computed.sensitivity[i], strict=True)),
            }
            for i in range(len(table.frequency))
        ],
    }


def _text(computed: ComputedModes) -> Iterator[str]:
    table = computed.modes
    yield "Natural frequencies (sigma from the tolerances) and shapes, largest motion 1 (m, rad):"
    yield _row(" mode      Hz   sigma  zeta %", [f"{name:>7}" for name in table.coordinates])
    for i, frequency in enumerate(table.frequency):
        start = f"{i + 1:5d} {frequency:7.2f} {table.sigma_frequency[i]:7.2f} {100 * table.damping_ratio[i]:7.2f}"
        yield _row(start, [f"{value:7.3f}" for value in table.shape[i].real])
    yield ""
    yield "Change of each natural frequency in % per 1 % of each stiffness:"
    yield _row(" mode      Hz", [f"{name:>12}" for name in computed.stiffnesses])
    for i, frequency in enumerate(table.frequency):
        yield _row(f"{i + 1:5d} {frequency:7.2f}", [f"{value:12.3f}" for value in computed.sensitivity[i]])


def _row(start: str, cells: list[str]) -> str:
    return start + " " + " ".join(cells)
