"""The search for effects that the model lacks."""
