"""Estimators: least squares (equation error), maximum likelihood, and what their results rest on."""
