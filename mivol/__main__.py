"""``python -m mivol`` is the command ``mivol``."""

from __future__ import annotations

from mivol.cli import main

raise SystemExit(main())
