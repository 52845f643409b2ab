"""Whether runs and geometry of a campaign agree: units, polarity, order, stiffness, position of the hub."""
