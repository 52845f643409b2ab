"""Damaged and changed files, seeded, through every reader of the program (`python -m studies mutation`)."""
