"""Workers for all tests of clusters."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from mivol.cluster.address import ClusterSettings
from mivol.cluster.connection import _connect, import_distributed


@pytest.fixture(scope="session")
def client() -> Iterator[object]:
    """Three local workers of one thread."""
    distributed = import_distributed()
    with _connect(distributed, ClusterSettings(scheduler="local", workers=3, threads=1)) as (client, _):
        yield client
