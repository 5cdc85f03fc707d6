"""The figures that a bench draws, kept in memory: no file is written."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import pytest
from matplotlib import rc_context
from matplotlib.figure import Figure

from mivol.report.figures import STYLE


@contextmanager
def kept(module: ModuleType, found: list[Figure], monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Keep the figures that a module draws, and write none."""

    @contextmanager
    def keep(path: Path, width: float, height: float) -> Iterator[Figure]:
        with rc_context(STYLE):
            found.append(Figure(figsize=(width, height)))
            yield found[-1]

    monkeypatch.setattr(module, "new_figure", keep)
    yield


def drawn(module: ModuleType, monkeypatch: pytest.MonkeyPatch, *arguments: object) -> Figure:
    """The one figure of a module's ``draw``."""
    found: list[Figure] = []
    with kept(module, found, monkeypatch):
        module.draw(*arguments)
    (figure,) = found
    return figure
