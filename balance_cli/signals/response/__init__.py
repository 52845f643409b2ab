"""Frequency responses: estimators, interpolation between lines, and the result of `sweep-tf`."""
