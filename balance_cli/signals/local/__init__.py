"""Local rational and polynomial models of a spectrum, for records that do not repeat."""
