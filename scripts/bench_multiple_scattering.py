#!/usr/bin/env python3
"""Light that scatters many times: how much sooner does mivol reach an error than Mitsuba's ``volpath`` and ``prbvolpath``?

See ``scripts/bench_multiple_scattering.py --help``; everything is in :mod:`mivol.bench.studies.multiple_scattering`.
"""

import sys

from mivol.bench.studies.multiple_scattering import main

if __name__ == "__main__":
    sys.exit(main())
