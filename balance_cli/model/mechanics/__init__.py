"""Equations of motion, and dual numbers that carry their derivatives."""
