"""Labels of the load points of an imported static run: its load series, and the kind of each point."""

from __future__ import annotations

import difflib
from typing import Any

from balance_cli.campaign.recording.import_map import ImportMap
from balance_cli.campaign.recording.point_labels import label_texts
from balance_cli.io.errors import UserError
from balance_cli.steps.import_signals import ChannelFinder


def point_labels(finder: ChannelFinder, mapping: ImportMap) -> dict[str, Any]:
    """The fields `series_labels` and `point_kinds` of a run, as far as the map asks for them.

    Raises UserError where the column is absent, or holds numbers that are no labels.
    """
    fields: dict[str, Any] = {}
    if mapping.series is not None:
        fields["series_labels"] = _read_labels(finder, mapping.series)
    if mapping.point_kind is not None:
        words = mapping.point_kind.words
        read = _read_labels(finder, mapping.point_kind.channel)
        fields["point_kinds"] = tuple(words.get(word, word.lower()) for word in read)
    return fields


def _read_labels(finder: ChannelFinder, name: str) -> tuple[str, ...]:
    for file in finder.files:
        if name in file.labels:
            return file.labels[name]()
    try:
        source = finder.find(name)
    except UserError as error:
        texts = [label for file in finder.files for label in file.labels]
        near = difflib.get_close_matches(name, texts, n=1)
        raise UserError(error.fault, error.file, error.place, f"Did you mean `{near[0]}`?") if near else error from None
    labels = label_texts(source.group.read([source.column], 0, source.group.samples)[:, 0])
    if labels is None:
        fault, place = "holds neither text nor whole numbers", f"channel `{name}`"
        raise UserError(fault, str(source.file.path), place, "Give a column of labels")
    return labels
