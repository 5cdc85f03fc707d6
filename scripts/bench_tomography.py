#!/usr/bin/env python3
"""How near to the truth are CG and ordered subsets after 5, 10 and 20 iterations, and what does an iteration cost?

See ``scripts/bench_tomography.py --help``; everything is in :mod:`mivol.bench.studies.tomography`.
"""

import sys

from mivol.bench.studies.tomography import main

if __name__ == "__main__":
    sys.exit(main())
