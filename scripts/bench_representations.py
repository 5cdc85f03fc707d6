#!/usr/bin/env python3
"""What do the same photographs become as grids and as Gaussians: how good, how soon, how large, how fast to show?

See ``scripts/bench_representations.py --help``; everything is in :mod:`mivol.bench.studies.representations`.
"""

import sys

from mivol.bench.studies.representations import main

if __name__ == "__main__":
    sys.exit(main())
