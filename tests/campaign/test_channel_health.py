"""Which channels are sound: every fault is found and named, and no sound channel is taken for a faulty one."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from balance_cli.campaign.recording.channel_health import channel_faults, live_channels
from balance_cli.campaign.recording.channel_statistics import gather_statistics
from balance_cli.campaign.recording.run import MemorySource, Run, SampleBlock
from balance_cli.campaign.recording.run_file import open_run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import geometry_from_dict, geometry_to_dict, load_geometry

Array = NDArray[np.float64]
ROOT = Path(__file__).parents[2]
SAMPLES = sorted((ROOT / "sample_data").glob("*.h5"))
RIG = load_geometry(ROOT / "configs" / "rts-6.yaml")
STEP = 20.0 / 2**16
"""Step of a 16-bit converter over +-10 V."""


def record(*channels: Array) -> Run:
    samples = np.column_stack(channels)
    names = tuple(f"c{index}" for index in range(samples.shape[1]))
    return Run("r", "R", "wind", names, len(samples), MemorySource(samples, None), has_loads=False, sample_rate=800.0)


def fault(channel: Array, limit: float | None = None) -> str:
    return channel_faults(record(channel), {"c0": limit}).get("c0", "")


def quantized(signal: Array, step: float = STEP) -> Array:
    return np.asarray(np.round(signal / step) * step, np.float32).astype(float)


def noise(samples: int = 20000, sigma: float = 1.0, seed: int = 0) -> Array:
    return np.random.default_rng(seed).normal(scale=sigma, size=samples)


def opened(path: Path) -> Run:
    return open_run(path)


@pytest.mark.parametrize("path", SAMPLES, ids=lambda path: path.stem)
def test_every_channel_of_the_sample_campaign_is_sound(path: Path) -> None:
    run = opened(path)
    health = live_channels(run, RIG)
    assert health.left_out == {}
    assert set(health.live) == set(run.channel_names)
    assert channel_faults(run, dict.fromkeys(run.channel_names)) == {}


@given(
    sigma=st.floats(0.35, 30.0),
    amplitude=st.sampled_from([0.0, 2.0, 20.0, 300.0]),
    frequency=st.floats(0.3, 150.0),
    offset=st.floats(-50.0, 50.0),
    seed=st.integers(0, 1000),
)
@settings(max_examples=60, deadline=None)
def test_a_quiet_and_coarsely_quantized_channel_is_sound(
    sigma: float, amplitude: float, frequency: float, offset: float, seed: int
) -> None:
    """All in steps of the converter: noise from a third of a step, sines from none to many, any offset."""
    time = np.arange(8000) / 800.0
    signal = offset + amplitude * np.sin(2 * np.pi * frequency * time) + noise(8000, sigma, seed)
    assert fault(quantized(signal, 1.0)) == ""


@given(st.floats(0.5, 100.0), st.floats(5.0, 2000.0), st.integers(1, 7))
@example(60.61887773803898, 652.0, 1)
@settings(max_examples=60, deadline=None)
def test_a_smooth_periodic_signal_without_noise_is_sound(frequency: float, amplitude: float, periods: int) -> None:
    """It dwells at its peaks, and repeats every value in each period."""
    time = np.arange(4000) / 800.0
    one = amplitude * (np.sin(2 * np.pi * frequency * time) + 0.3 * np.cos(2 * np.pi * 1.7 * frequency * time))
    assert fault(np.tile(one, periods)) == ""
    assert fault(quantized(np.tile(one, periods), 1.0)) == ""


@pytest.mark.parametrize("value", [0.0, -3.25])
def test_a_constant_channel_is_dead(value: float) -> None:
    assert fault(np.full(1000, value)) == f"dead: constant at {value:.6g} V"


@pytest.mark.parametrize(("ends", "is_end"), [((12000, 12001, 12000), True), ((12000, 15000, 12000), False)])
def test_channels_that_end_together_are_a_record_that_ended(ends: tuple[int, ...], is_end: bool) -> None:
    """As of force plates, whose program fills up a record of fixed length with zeros."""
    at = np.arange(20000)
    channels = [np.where(at < end, quantized(noise(seed=seed)), 0.0) for seed, end in enumerate(ends)]
    faults = channel_faults(record(*channels), dict.fromkeys(("c0", "c1", "c2")))
    assert all(text.startswith("dead for part of the record: constant at 0 V from sample ") for text in faults.values())
    assert [text.endswith("to have ended there, cut the record") for text in faults.values()] == [is_end] * 3


@pytest.mark.parametrize(("start", "stop"), [(0, 5000), (7000, 7100), (12000, 20000), (20, 20000), (0, 19990)])
@pytest.mark.parametrize("sigma", [0.7 * STEP, 1.0])
def test_a_channel_that_dies_for_part_of_the_record_is_found(start: int, stop: int, sigma: float) -> None:
    channel = quantized(noise(20000, sigma))
    channel[start:stop] = 4.0
    assert fault(channel) == f"dead for part of the record: constant at 4 V from sample {start} to {stop - 1}"


@pytest.mark.parametrize(("loaded_from", "is_sound"), [(150, True), (20, False)])
def test_coarse_steps_hide_the_response_before_the_loads_begin(loaded_from: int, is_sound: bool) -> None:
    """A sweep from rest: 100 constant samples at its start are no fault of the channel unless loads act in them."""
    time = np.arange(8000)
    channel = quantized(20.0 * np.sin(0.3 * time) * (time >= 100), 1.0)
    load = np.outer(np.sin(0.3 * time) * (0.05 + (time >= loaded_from)), np.eye(6)[2])
    run = replace(record(channel), kind="sweep", has_loads=True, source=MemorySource(channel[:, None], load))
    assert (channel_faults(run, {"c0": None}) == {}) == is_sound


def test_samples_that_are_not_finite_are_counted() -> None:
    channel = noise()
    channel[[7, 9000]] = np.nan, np.inf
    assert fault(channel) == "not finite: 2 of 20000 samples, the first is sample 7, more than can be bridged"


@pytest.mark.parametrize("value", [1e300, -1e10])
def test_a_channel_of_absurd_values_is_not_plausible(value: float) -> None:
    channel = noise()
    channel[7] = value
    assert fault(channel) == f"not plausible: reaches {value:.6g} V"
    assert fault(np.full(1000, value)) == f"not plausible: reaches {value:.6g} V"


def test_a_channel_of_vanishing_values_is_not_plausible() -> None:
    assert fault(1e-300 * noise()).startswith("not plausible: never exceeds")
    assert fault(1e-20 * noise()) == ""


@pytest.mark.parametrize("limits", [(-10.0, 10.0), (-99.0, 10.0), (-10.0, 99.0)])
def test_a_sample_at_the_declared_range_is_clipped(limits: tuple[float, float]) -> None:
    channel = noise(sigma=2.0)
    channel[:5] = 12.0, -12.0, 0.0, 11.0, -11.0
    cut = np.clip(channel, *limits)
    cut = cut.astype(np.float32).astype(float)
    assert fault(cut, 10.0).startswith("clipped: reaches")
    assert fault(0.8 * noise(sigma=2.0), 10.0) == ""


@pytest.mark.parametrize("frequency", [3.0, 17.5, 140.0, 390.0])
@pytest.mark.parametrize("step", [None, STEP])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_without_a_range_clipping_shows_in_the_extreme(frequency: float, step: float | None, side: float) -> None:
    time = np.arange(20000) / 800.0
    signal = side * np.minimum(np.sin(2 * np.pi * frequency * time) + noise(sigma=0.02), 0.9)
    channel = signal if step is None else quantized(signal)
    assert fault(channel).startswith("clipped: ")
    assert fault(channel, 5.0).startswith("clipped: ")


def test_clipped_load_points_show_where_nothing_else_repeats() -> None:
    run = opened(ROOT / "sample_data" / "static-bare.h5")
    samples = run.read().channels.copy()
    third = np.sort(samples[:, 3])[-3]
    samples[:, 3] = np.sort(np.minimum(samples[:, 3], third))
    health = live_channels(replace(run, source=MemorySource(samples, run.read().loads)), RIG)
    assert health.left_out == {"z1.strain": f"clipped: 3 samples at its extreme of {third:.6g} V"}


@dataclass(frozen=True)
class Parts:
    """The same samples, handed out in blocks of a given size."""

    run: Run
    size: int

    def __getattr__(self, name: str) -> object:
        return getattr(self.run, name)

    def blocks(self) -> Iterator[SampleBlock]:
        return self.run.blocks(self.size)


@given(st.integers(1, 40), st.integers(0, 60), st.integers(0, 60), st.integers(0, 5))
@settings(max_examples=60, deadline=None)
def test_the_size_of_the_blocks_does_not_matter(size: int, start: int, length: int, seed: int) -> None:
    channel = quantized(noise(120, 1.0, seed), 0.5)
    channel[start : start + length] = 1.5
    other = np.minimum(noise(120, 1.0, seed), 0.5)
    run = record(channel, other, np.where(np.arange(120) == start, np.nan, other))
    whole = channel_faults(run, dict.fromkeys(run.channel_names))
    assert channel_faults(Parts(run, size), dict.fromkeys(run.channel_names)) == whole  # type: ignore[arg-type]


def test_what_is_wrong_in_a_run_is_named_by_channel() -> None:
    run = opened(ROOT / "sample_data" / "wind-1.h5")
    samples = run.read().channels.copy()
    column = run.channel_names.index
    samples[:, column("torque")] = 0.02
    samples[:, column("z1.piezo")] = samples[:, column("z1.piezo")].clip(-5.0, 5.0)
    samples[100, column("x.strain")] = np.nan
    kept = [index for index, name in enumerate(run.channel_names) if name != "y2.piezo"]
    names = tuple(run.channel_names[index] for index in kept)
    health = live_channels(
        replace(run, source=MemorySource(samples[:, kept], None), channel_names=(*names,)), with_range(5.0)
    )
    reasons = {name: reason.split(":")[0] for name, reason in health.left_out.items()}
    assert reasons == {
        "x.strain": "not finite",
        "y2.piezo": "absent from the run",
        "z1.piezo": "clipped",
        "z2.piezo": "clipped",
        "z3.piezo": "clipped",
        "torque": "clipped",
    } | {"torque": "dead"}
    assert set(health.live) == set(RIG.channel_names) - set(reasons)
    assert list(health.live) == [name for name in RIG.channel_names if name in health.live]


def with_range(limit: float) -> Geometry:
    declared = geometry_to_dict(RIG)
    for channel in declared["channels"]:
        channel["range"] = limit
    return geometry_from_dict(declared)


def test_a_static_run_needs_only_the_channels_that_pass_a_constant_load() -> None:
    run = opened(ROOT / "sample_data" / "static-bare.h5")
    samples = run.read().channels.copy()
    samples[:, 2] = 0.1
    samples[60:, 4] = 0.2
    loads = run.read().loads
    health = live_channels(replace(run, source=MemorySource(samples, loads)), RIG)
    assert {name: reason.split(":")[0] for name, reason in health.left_out.items()} == {
        "y2.strain": "dead",
        "z2.strain": "dead for part of the record",
    }
    assert len(health.live) == 6


@pytest.mark.parametrize(("channel", "load"), [("torque", "Mz"), ("x.strain", "Fx")])
def test_in_a_static_run_a_channel_may_stand_still_as_long_as_its_loads_do(channel: str, load: str) -> None:
    """Load points without any noise: each channel stands still while nothing that reaches it changes."""
    run = opened(ROOT / "sample_data" / "static-bare.h5")
    column, component = run.channel_names.index(channel), COMPONENTS.index(load)
    block = run.read()
    samples, loads = block.channels.copy(), np.array(block.loads)
    own = [component] if channel == "torque" else [0, 1, 2, 3, 4]
    loads[:100, own] = 0.0
    samples[:100, column] = 5.0
    still = replace(run, source=MemorySource(samples, loads))
    assert live_channels(still, RIG).left_out == {}
    loads[50, component] = 1.0
    assert list(live_channels(still, RIG).left_out) == [channel]
    assert list(channel_faults(still, dict.fromkeys(run.channel_names))) == [channel]


def test_one_load_point_is_no_evidence() -> None:
    run = opened(ROOT / "sample_data" / "static-bare.h5")
    samples, loads = run.read().channels, run.read().loads
    one = replace(run, samples=1, source=MemorySource(samples[:1], None if loads is None else loads[:1]))
    assert len(live_channels(one, RIG).live) == 8


@pytest.mark.parametrize("kind", ["coarse", "smooth", "not finite"])
@pytest.mark.parametrize("block", [97, 1 << 16])
def test_statistics_of_a_channel_are_those_of_its_definition(monkeypatch, kind, block):
    monkeypatch.setattr("balance_cli.campaign.recording.channel_statistics.BLOCK_SAMPLES", block)
    values = np.sin(np.arange(1000) / 7.0) + 0.1 * np.random.default_rng(3).standard_normal(1000)
    values = np.round(values, 1) if kind != "smooth" else values
    values[400:430] = 0.5
    if kind == "not finite":
        values[[5, 600]] = np.nan
    (found,) = gather_statistics(record(values), ["c0"])
    finite = values[np.isfinite(values)]
    directions = np.sign(np.diff(values))
    directions = directions[np.isfinite(directions) & (directions != 0.0)]
    assert found.nonfinite_count == 1000 - len(finite)
    assert found.repeated_count == np.count_nonzero(values[1:] == values[:-1])
    assert found.turning_points == np.count_nonzero(np.diff(directions))
    assert (found.flatline_start, found.flatline_value) == (400 - (values[399] == 0.5), 0.5)
    assert found.flatline_length == 430 - found.flatline_start + (values[430] == 0.5)
    distinct, counts = np.unique(finite, return_counts=True)
    np.testing.assert_array_equal(found.lowest, (distinct[:8], counts[:8]))
    np.testing.assert_array_equal(found.highest, (distinct[:-9:-1], counts[:-9:-1]))


def test_a_channel_that_repeats_another_sensor_is_left_out_with_it():
    """Which of the two was recorded is not known."""
    names = [channel.name for channel in RIG.channels]
    samples = noise(70_000 * len(names)).reshape(-1, len(names))
    samples[:, names.index("z2.piezo")] = samples[:, names.index("z1.piezo")]
    run = replace(record(*samples.T), channel_names=tuple(names))
    assert live_channels(run, RIG).left_out == {
        "z1.piezo": "equal to z2.piezo in every sample",
        "z2.piezo": "equal to z1.piezo in every sample",
    }
    samples[-1, names.index("z2.piezo")] += 1.0
    assert live_channels(replace(run, source=MemorySource(samples, None)), RIG).left_out == {}
