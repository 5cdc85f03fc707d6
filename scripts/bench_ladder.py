#!/usr/bin/env python3
"""One scene, four models of light: how do the errors of images and gradients fall with time, for mivol and for Mitsuba?

See ``scripts/bench_ladder.py --help``; everything is in :mod:`mivol.bench.studies.ladder`.
"""

import sys

from mivol.bench.studies.ladder import main

if __name__ == "__main__":
    sys.exit(main())
