#!/usr/bin/env python3
"""What a scene costs on a grid: bytes per cell and per scene, from 128^3 to 1024^3 cells, as the lecture counts them.

See ``scripts/storage.py --help``; everything is in :mod:`mivol.bench.studies.storage`.
"""

import sys

from mivol.bench.studies.storage import main

if __name__ == "__main__":
    sys.exit(main())
