"""Effects of all channels that look the same as effects of all loads, or the reverse."""

from __future__ import annotations

from collections.abc import Collection

from balance_cli.campaign.rig.channel_groups import ALL
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.load_components import carried_components
from balance_cli.model.effects.places import acts_on_loads, channels_at
from balance_cli.model.effects.search_hints import CommonAlternative
from balance_cli.model.placed_effects import PlacedEffect


def alike_in_all(
    effect: PlacedEffect, geometry: Geometry, is_good: bool = True, swept: Collection[str] | None = None
) -> CommonAlternative | None:
    """Return the effect that looks the same as this one in all channels, or loads; None where it acts on some.

    Where not all is explained (`is_good`), a torque meter that an effect of all cells leaves out proves nothing. Nor do
    loads that no run has `swept`: these are the components (None: all) that tell a load from the channels.
    """
    alike = effect.effect.search.alike_in_all
    if alike is None or effect.where == (ALL,):
        return alike
    if acts_on_loads(effect.effect.places, geometry):
        carried = set(carried_components(geometry))
        compared = carried if swept is None else carried & set(swept)
        return alike if compared and compared <= set(effect.where) else None
    left_out = [item for item in geometry.channels if item.name not in channels_at(geometry, effect.where)]
    return None if any(is_good or item.cell_weights for item in left_out) else alike
