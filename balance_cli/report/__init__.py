"""The report: figures, tables and the page, made from artefacts alone."""
