#!/usr/bin/env python3
"""How many pixels a second are splatted from clouds of Gaussians, forward and backward, beside what Mitsuba draws of them?

See ``scripts/bench_points.py --help``; everything is in :mod:`mivol.bench.studies.points`.
"""

import sys

from mivol.bench.studies.points import main

if __name__ == "__main__":
    sys.exit(main())
