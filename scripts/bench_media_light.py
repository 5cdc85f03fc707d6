#!/usr/bin/env python3
"""Light of media that emit: how much sooner is an error reached where it may be drawn than where it is met by chance?

See ``scripts/bench_media_light.py --help``; everything is in :mod:`mivol.bench.studies.media_light`.
"""

import sys

from mivol.bench.studies.media_light import main

if __name__ == "__main__":
    sys.exit(main())
