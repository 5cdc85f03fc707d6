#!/usr/bin/env python3
"""Are pictures of random scenes those of Mitsuba, and is every path of hard ones a radiance?

See ``scripts/bench_random_scenes.py --help``; everything is in :mod:`mivol.bench.studies.random_scenes`.
"""

import sys

from mivol.bench.studies.random_scenes import main

if __name__ == "__main__":
    sys.exit(main())
