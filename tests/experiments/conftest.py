"""What the tests of several modules of the room share."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_experiment import write_experiment


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scene, its start volume and an experiment."""
    return write_experiment(tmp_path)


@pytest.fixture(autouse=True)
def _plain_figures(plain_figures: None) -> None:
    """Figures are not drawn: tests of pages and figures are in tests/cli and tests/report."""
