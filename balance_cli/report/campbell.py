"""Campbell diagram: eigenfrequencies over rotor speed, the multiples of the speed, and how far apart they are."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Rotor
from balance_cli.estimation.identified_model import IdentifiedModel, identified_system
from balance_cli.model.modes import modes
from balance_cli.report.blocks import Chart, PageBlock, Row, Table, TableCell, plain_row
from balance_cli.report.figure_style import BLACK, BLUE, EXTRA_COLORS, GRAY, GREEN, ORANGE, SKY, VERMILION
from balance_cli.report.frequencies import modal_assurance, sigma_scale
from balance_cli.report.number_format import format_fixed, format_significant, value_and_sigma_text
from balance_cli.report.plots import Marker, Plot, Trace
from balance_cli.report.sources import Source

Array = NDArray[np.float64]

SPEEDS = 41
LAST_RAY = 8
"""Highest multiple of the speed, or twice the blades: the harmonics that are reduced by default."""
HIGHEST_SPEED = 1.25
"""Highest speed of the diagram, relative to the nominal one."""
SPEED_LABEL, FREQUENCY_LABEL = "rotor speed [Hz]", "frequency [Hz]"
MODE_COLORS = (BLUE, ORANGE, GREEN, VERMILION, SKY, *EXTRA_COLORS)
CLOSE = 1.0
"""Distance of a multiple of the speed from a mode, in half-power bandwidths 2 zeta f, below which it is marked: the
response is then more than 45 % of its peak (1 / sqrt(1 + 4))."""


def campbell_blocks(source: Source[IdentifiedModel], speeds_of_runs: tuple[float, ...]) -> Iterator[PageBlock]:
    """Yield the diagram and the table of distances at nominal speed; nothing without a rotor or modes."""
    model = source.content
    rotor = model.geometry.rotor
    if rotor is None or not rotor.speed > 0 or not len(model.modes.frequency) or model.paper is not None:
        return
    highest = max(HIGHEST_SPEED * rotor.speed, *speeds_of_runs, 0.0)
    speeds = np.linspace(0.0, highest, SPEEDS)
    tracks = eigenfrequencies(model, speeds)
    markers = (Marker(rotor.speed, "nominal"), *(Marker(speed, "") for speed in speeds_of_runs))
    traces = (*_mode_traces(tracks), *_ray_traces(rotor, speeds, float(np.nanmax(tracks))))
    plot = Plot("", speeds, traces, SPEED_LABEL, FREQUENCY_LABEL, False, markers, (0.0, _top(tracks, rotor)), 420)
    turning = np.ptp(tracks, axis=0).max() > 1e-6 * tracks.max()
    runs = (
        " Dashed lines: nominal speed and mean speeds of the runs."
        if speeds_of_runs
        else " Dashed line: nominal speed."
    )
    caption = (
        f"Campbell diagram of {source.label}: eigenfrequencies over rotor speed, "
        f"{'with' if turning else 'without'} gyroscopic coupling, and multiples n/rev of the speed (dark: 1/rev and "
        f"multiples of the {rotor.blades} blades).{runs}"
    )
    yield Chart.single("campbell", caption, (plot,), wide=True)
    yield _distance_table(source, rotor)


def eigenfrequencies(model: IdentifiedModel, speeds: Array) -> Array:
    """Return the eigenfrequencies (k, m) [Hz] at rotor speeds (k,) [Hz], each mode followed by its shape.

    NaN where a mode is overdamped. Without gyroscopic coupling they are those at rest.
    """
    system = identified_system(model)
    first = modes(system)
    result = np.tile(first.frequency, (len(speeds), 1))
    if not system.pencil.gyroscopic.value.any():
        return result
    shape = first.shape
    for k, speed in enumerate(speeds):
        now = modes(system, float(speed))
        order = _match_modes(shape, now.shape)
        result[k] = [now.frequency[i] if i is not None else np.nan for i in order]
        shape = np.array([now.shape[i] if i is not None else shape[m] for m, i in enumerate(order)])
    return result


def _match_modes(before: NDArray[np.complex128], after: NDArray[np.complex128]) -> list[int | None]:
    """The mode of `after` that each mode of `before` has become, by their shapes."""
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(modal_assurance(before, after), maximize=True)
    partner = dict(zip(rows.tolist(), columns.tolist(), strict=True))
    return [partner.get(m) for m in range(len(before))]


def _top(tracks: Array, rotor: Rotor) -> float:
    """Upper end of the frequency axis: above the reduced harmonics, or above the modes where these lie lower."""
    harmonics = (max(LAST_RAY, 2 * rotor.blades) + 1) * rotor.speed
    return float(min(harmonics, 1.1 * np.nanmax(tracks)))


def _mode_traces(tracks: Array) -> Iterator[Trace]:
    for m in range(tracks.shape[1]):
        color = MODE_COLORS[m % len(MODE_COLORS)]
        yield Trace(f"{tracks[0, m]:.4g} Hz", tracks[:, m], color, width=1.8)


def _ray_traces(rotor: Rotor, speeds: Array, top: float) -> Iterator[Trace]:
    last = int(min(max(LAST_RAY, 2 * rotor.blades), np.ceil(top / rotor.speed)))
    for n in range(1, last + 1):
        of_blades = n == 1 or n % rotor.blades == 0
        color, width = (BLACK, 1.4) if of_blades else (GRAY, 0.7)
        yield Trace(f"{n}/rev", n * speeds, color, (5.0, 3.0), width)


def _distance_table(source: Source[IdentifiedModel], rotor: Rotor) -> Table:
    """The multiple of the nominal speed next to each mode, and the distance in bandwidths."""
    model = source.content
    system = identified_system(model)
    at_speed = eigenfrequencies(model, np.array([rotor.speed]))[0]
    damping = modes(system).damping_ratio
    scale = sigma_scale(model)
    rows: list[Row] = []
    for frequency, zeta, sigma in zip(at_speed, damping, model.modes.sigma_frequency, strict=True):
        n = max(1, round(float(frequency / rotor.speed))) if np.isfinite(frequency) else 1
        distance = n * rotor.speed - frequency
        bandwidths = abs(distance) / (2 * zeta * frequency) if zeta > 0 else float("nan")
        value, spread = value_and_sigma_text(float(frequency), scale * float(sigma))
        rows.append(
            (
                TableCell(value, f"\N{PLUS-MINUS SIGN} {spread}", "name"),
                TableCell(f"{n}/rev", f"{n * rotor.speed:.4g} Hz"),
                TableCell(f"{format_fixed(float(100 * distance / frequency), 1)} %"),
                TableCell(format_significant(float(bandwidths), 2), mark="bad" if bandwidths < CLOSE else ""),
            )
        )
    head = plain_row("mode [Hz]", "nearest multiple", "away by", "in bandwidths")
    caption = (
        f"Distance of each mode from the nearest multiple of the nominal speed ({rotor.speed:.4g} Hz); a bandwidth is "
        "twice the damping ratio times the frequency. Marked: within one bandwidth, where loads of this harmonic "
        "depend most on the model."
    )
    return Table(caption, (head,), tuple(rows))
