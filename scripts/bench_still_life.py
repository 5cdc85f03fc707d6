#!/usr/bin/env python3
"""Does a radiance field see that light depends on the direction, and does total variation help where views are few?

See ``scripts/bench_still_life.py --help``; everything is in :mod:`mivol.bench.studies.still_life`.
"""

import sys

from mivol.bench.studies.still_life import main

if __name__ == "__main__":
    sys.exit(main())
