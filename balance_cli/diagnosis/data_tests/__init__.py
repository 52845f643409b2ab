"""Tests of the measured data against themselves, without a mechanical model."""
