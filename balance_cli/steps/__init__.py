"""The steps of the chain: pure functions from data to results, one for each command."""
