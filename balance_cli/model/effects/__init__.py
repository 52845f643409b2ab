"""The library of effects, in the order in which they act; a new effect is one file and one line here.

A mass on the plate comes first, because the plate's damping may follow it, then the support of the cells: misaligned
cells and transverse stiffness act on the motion relative to it.
"""

from balance_cli.model.effects import (
    added_mass,
    cell_dashpot,
    cell_misalignment,
    cell_position,
    channel_gain,
    channel_offset,
    crosstalk,
    cubic_stiffness,
    dry_friction,
    exciter_mass,
    exciter_misalignment,
    exciter_position,
    extra_mode,
    free_play,
    gyroscopic_coupling,
    high_pass,
    load_delay,
    load_gain,
    load_offset,
    low_pass,
    mains_pickup,
    mast_bending,
    parallel_dashpot,
    parallel_stiffness,
    quadratic_stiffness,
    saturation,
    structural_damping,
    support_flexibility,
    time_delay,
    transverse_stiffness,
    viscous_damping,
    weight_misalignment,
)
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Choice, Where

EFFECTS: tuple[Effect, ...] = (
    added_mass.EFFECT,
    support_flexibility.EFFECT,
    mast_bending.EFFECT,
    gyroscopic_coupling.EFFECT,
    parallel_stiffness.EFFECT,
    parallel_dashpot.EFFECT,
    cell_misalignment.EFFECT,
    cell_position.EFFECT,
    transverse_stiffness.EFFECT,
    cell_dashpot.EFFECT,
    viscous_damping.EFFECT,
    structural_damping.EFFECT,
    cubic_stiffness.EFFECT,
    quadratic_stiffness.EFFECT,
    free_play.EFFECT,
    dry_friction.EFFECT,
    extra_mode.EFFECT,
    channel_gain.EFFECT,
    low_pass.EFFECT,
    high_pass.EFFECT,
    time_delay.EFFECT,
    crosstalk.EFFECT,
    saturation.EFFECT,
    exciter_mass.EFFECT,
    load_gain.EFFECT,
    load_delay.EFFECT,
    exciter_misalignment.EFFECT,
    exciter_position.EFFECT,
    weight_misalignment.EFFECT,
    load_offset.EFFECT,
    mains_pickup.EFFECT,
    channel_offset.EFFECT,
)

__all__ = ["EFFECTS", "Choice", "Effect", "EffectParameter", "Where"]
