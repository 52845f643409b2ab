"""From channels to hub loads: mean loads, harmonic loads, loads in time."""
