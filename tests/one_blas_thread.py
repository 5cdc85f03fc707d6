"""NumPy's BLAS uses one thread. Imported before NumPy, it holds for pytest-xdist's workers too, which inherit it.

The matrices of the tests are small, and a second thread of OpenBLAS spins while it waits for work: of tests that fill their
matrices in float64 it takes a third of the processor time, from the worker beside.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
