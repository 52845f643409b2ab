"""Files: artefacts, HDF5 trees, writing whole files, and the one error that a user sees."""
