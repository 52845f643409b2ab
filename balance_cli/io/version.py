"""Version of the program, as artefacts and files of other programs record it."""

__version__ = "0.2.0"
