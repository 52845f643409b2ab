"""Effects of a simulated rig, in the time domain."""
