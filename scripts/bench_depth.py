#!/usr/bin/env python3
"""How much of the light that a medium scatters is missing where it may scatter once only (max_depth 2)?

See ``scripts/bench_depth.py --help``; everything is in :mod:`mivol.bench.studies.depth`.
"""

import sys

from mivol.bench.studies.depth import main

if __name__ == "__main__":
    sys.exit(main())
