"""Benchmarks: ratios, side by side in one run (`make bench`)."""

import os

# One core: the threads of a linear algebra library wait for each other, and their waiting counts as processor time.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
