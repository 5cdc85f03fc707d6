#!/usr/bin/env python3
"""Density gradients of light that scatters once or often: how exact are they, how much sooner than those of ``prbvolpath``?

See ``scripts/bench_gradients.py --help``; everything is in :mod:`mivol.bench.studies.gradients`.
"""

import sys

from mivol.bench.studies.gradients import main

if __name__ == "__main__":
    sys.exit(main())
