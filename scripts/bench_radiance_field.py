#!/usr/bin/env python3
"""How fast are a radiance field's rays and their derivatives, and how much sooner is a fit done, beside Mitsuba's tutorial?

See ``scripts/bench_radiance_field.py --help``; everything is in :mod:`mivol.bench.studies.radiance_field`.
"""

import sys

from mivol.bench.studies.radiance_field import main

if __name__ == "__main__":
    sys.exit(main())
