"""Runs as recorded: their file, its schema, and the health of the channels."""
