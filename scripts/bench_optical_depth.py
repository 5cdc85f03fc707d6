#!/usr/bin/env python3
"""What does an exact optical depth cost, and how exact is it, beside what else could be used?

See ``scripts/bench_optical_depth.py --help``; everything is in :mod:`mivol.bench.studies.optical_depth`.
"""

import sys

from mivol.bench.studies.optical_depth import main

if __name__ == "__main__":
    sys.exit(main())
