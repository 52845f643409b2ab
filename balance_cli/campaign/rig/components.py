"""Names and units of components, motions, kinds of run and excitations; a module without imports."""

COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
UNITS = ("N", "N", "N", "N m", "N m", "N m")
UNIT_OF = dict(zip(COMPONENTS, UNITS, strict=True))
FREEDOMS = ("x", "y", "z", "psi", "theta", "phi")
RUN_KINDS = ("static", "zero", "sweep", "check", "wind")
EXCITATIONS = ("multisine", "random", "sine-sweep", "stepped", "impact")
