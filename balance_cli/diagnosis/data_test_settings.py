"""Tuning constants of the tests that need no model of the plate."""

from __future__ import annotations

from dataclasses import dataclass, field

from balance_cli.diagnosis.significance import DATA_TEST_LEVEL


@dataclass(frozen=True)
class ChannelPairSettings:
    """Two channels of one cell against each other."""

    max_kinds: int = 2
    """Kinds of difference that a finding may combine."""
    min_kind_gain: float = 25.0
    """Decrease of chi-square that a further kind must bring: five sigma of its parameter."""
    max_remaining_share: float = 0.5
    """Share of chi-square that a large difference leaves at most. Smaller ones are left to the score test."""
    steps: int = 12
    """Gauss-Newton steps of a fit of the ratio of two channels."""
    min_step_gain: float = 1e-6
    """Decrease of chi-square that a further step must promise."""
    min_step_fraction: float = 1e-3
    """Smallest fraction of a step that is tried before the fit ends."""
    start_lines: int = 600
    """Spectral lines on which first values of a parameter are compared."""
    start_values: int = 61
    """First values that are compared, on a geometric scale over the whole range of a parameter."""


@dataclass(frozen=True)
class RunPairSettings:
    """Sweeps of the same components against each other."""

    max_level_ratio: float = 0.9
    """Ratio of two levels up to which they are different levels."""
    bands: int = 20
    """Frequency bands, each of which is tested by itself."""
    min_shared_lines: int = 10
    """Lines that two runs must share, and a band must hold."""
    cross_load_share: float = 1e-3
    """Share of the driven load that any other load may have at the same line."""
    cross_load_sigma: float = 5.0
    """Sigma of its noise that such a load may have instead."""
    clear_sigma: float = 5.0
    """Sigma that a change of frequency or damping must have to be named."""
    minor_share: float = 0.3
    """Share of the larger of the two below which the other one is taken for an error of the derivative."""
    transient_factor: float = 3.0
    """Initial value of a high-pass transient, over the rms of the channel: three sigma."""
    gain_share: float = 0.9
    """Share of chi-square that factors of the channels must describe: modes that move leave most of theirs."""


@dataclass(frozen=True)
class StaticPairSettings:
    """Static runs against the sweeps at low frequency."""

    max_frequency_share: float = 0.4
    """Share of the lowest eigenfrequency up to which lines are used: there the series below converges."""
    min_lines: int = 6
    """Such lines that a sweep must have for each driven component."""
    terms: int = 6
    """Terms of the power series: the first one neglected is 0.4^12 = 2e-5."""
    free_terms: int = 2
    """Terms that are free. The others are held to the size of the response itself."""
    max_dof: float = 1e9
    """Degrees of freedom above which a covariance is as good as known."""
    max_condition: float = 1e8
    """Condition number of the static loads above which a run does not separate its components."""


@dataclass(frozen=True)
class MainsDetectionSettings:
    """Lines at the mains frequency and its multiples against their neighbors."""

    half_window: int = 13
    """Lines of a window on either side of its middle: enough for the local model of highest order."""
    neighbor_offsets: tuple[int, ...] = (-14, -10, -7, -4, 4, 7, 10, 14)
    """Middles of neighboring windows, in lines from that of the mains."""
    excluded_bins: float = 1.01
    """Distance from the mains, in bins, within which a line is left out of every fit: a main lobe, and rounding."""
    response_order: int = 3
    """Order of the numerator of the local model."""
    denominator_orders: tuple[int, ...] = (0, 2, 3)
    """Orders of its denominator, the simplest first: no resonance, one, and one beside the slope of another."""
    min_run_p_value: float = 1e-4
    """Smallest p-value that one run may have: now and then a local model finds a wrong pole."""
    min_neighbor_count: float = 8.0
    """Real values that the neighbors must have."""
    max_window_chi2: float = 1.5
    """chi2/dof up to which a local model describes its window."""
    hidden_peak_lines: float = 3.0
    """Distance of a pole from the middle, in lines, within which the lines left out could hide its peak."""
    shapes: int = 3
    """Shapes of the moving rig that are removed: as many as directions."""
    rotor_harmonic_bins: float = 2.0
    """Distance from a rotor harmonic, in bins, within which a line of the mains is not tested."""


@dataclass(frozen=True)
class RunChangeSettings:
    """The ratio of two channels of a cell in one run against that in the others."""

    min_signal_to_noise: float = 100.0
    """Power of both channels over that of their noise: with less, the ratio is no linear function of the noise."""


@dataclass(frozen=True)
class RecordChangeSettings:
    """The ratio of two channels of a cell in the first half of a periodic record against the last."""

    min_half_periods: int = 2
    """Periods in each half: with one each, a single disturbance would be a drift."""
    min_channels: int = 3
    """Channels that are compared with each other: of two that differ neither is the one that drifts."""
    clear_sigma: float = 3.0
    """Distance from the other group at which a channel is named: one that was hardly loaded could belong to either."""


@dataclass(frozen=True)
class ZeroDriftSettings:
    """Means of swept records, run against run."""

    min_runs: int = 4
    """Runs that a channel must have a mean in: with three, one odd run decides."""
    min_channels: int = 3
    """Channels that are tested together: with fewer a force of a cell and a zero look alike."""
    response_error: float = 0.2
    """Share by which the static response to a mean load may be wrong before any effect is found."""
    cell_share: float = 0.5
    """Share of the scatter above which a rectified motion of one cell describes it: of ten runs chance gives 0.1."""


@dataclass(frozen=True)
class CommonLoadGainSettings:
    """Load gains of several components that are one factor."""

    min_components: int = 3
    """Load gains that must agree: two components may share an exciter, and so its force cell; three do not."""
    max_spread: float = 0.1
    """Of the departure from one: of gains of their own, three so close are a chance of some percent."""
    max_sigma: float = 3.0
    """Standard deviations between the gain of one component and that of all."""


@dataclass(frozen=True)
class ExclusionSettings:
    """Channels and runs that are left out where no effect describes all data."""

    min_excess_share: float = 0.2
    """Share of all residual beyond the noise from which a channel or run is suspected: with fewer, many are wrong."""
    max_share_left: float = 0.05
    """Share of chi-square that the likely cause of a channel may leave: a fifth of its residual, whose root it is."""


@dataclass(frozen=True)
class UnidentifiableSettings:
    """Parameters of effects that the data do not determine."""

    known_to: float = 2.0
    """Distance of a parameter from its null over its standard deviation, from which the data determine it."""
    largest_sigma: float = 100.0
    """Of the size of a change of a parameter that matters (its scale): one that is known to be small is determined. Of
    a support it is ten times the mass of what moves on it."""


@dataclass(frozen=True)
class DataTestSettings:
    """All tests of the data."""

    significance_level: float = DATA_TEST_LEVEL
    """p-value, corrected for the looks at one row, below which a finding is named."""
    channel_pairs: ChannelPairSettings = field(default_factory=ChannelPairSettings)
    run_pairs: RunPairSettings = field(default_factory=RunPairSettings)
    static_pairs: StaticPairSettings = field(default_factory=StaticPairSettings)
    run_changes: RunChangeSettings = field(default_factory=RunChangeSettings)
    record_changes: RecordChangeSettings = field(default_factory=RecordChangeSettings)
    mains: MainsDetectionSettings = field(default_factory=MainsDetectionSettings)
    zero_drift: ZeroDriftSettings = field(default_factory=ZeroDriftSettings)
    common_load_gain: CommonLoadGainSettings = field(default_factory=CommonLoadGainSettings)
    unidentifiable: UnidentifiableSettings = field(default_factory=UnidentifiableSettings)
    exclusions: ExclusionSettings = field(default_factory=ExclusionSettings)
