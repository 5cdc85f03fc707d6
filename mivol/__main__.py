"""Run the command ``mivol`` as ``python -m mivol``."""

from __future__ import annotations

from mivol.cli import main

raise SystemExit(main())
