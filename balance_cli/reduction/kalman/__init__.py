"""Hub loads in time: Kalman filters and smoothers for unknown loads (docs/theory/filters.md)."""
