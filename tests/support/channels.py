"""Runs with a channel changed."""

from __future__ import annotations

from dataclasses import replace

from balance_cli.campaign.recording.run import MemorySource


def with_channel(run, name, change):
    """Return the run with one channel changed."""
    block = run.read()
    channels = block.channels.copy()
    column = run.channel_names.index(name)
    channels[:, column] = change(channels[:, column])
    return replace(run, source=MemorySource(channels, block.loads))
