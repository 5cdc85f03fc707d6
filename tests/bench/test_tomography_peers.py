"""The bench of slices beside other programs: all see the same object the same way round."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from mivol.bench import tomography_peers as peers
from mivol.tomography.phantoms import random_ellipsoids

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("who", ["mivol", *peers.PEERS])
def test_everyone_finds_the_object(variant_rgb: str, monkeypatch: pytest.MonkeyPatch, who: str) -> None:
    """Each method's least error is below 0.75, where an empty slice has 1 and one that is upside down, or mirrored, more."""
    module, run = peers.PEERS.get(who, ("numpy", peers.ours))
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"{who} is not installed")
    monkeypatch.setattr(peers, "STEPS", dict.fromkeys(peers.STEPS, 12))
    # Ellipsoids that lie anywhere: a head is nearly its own mirror image.
    monkeypatch.setattr(peers, "shepp_logan", lambda table, half: random_ellipsoids(5, seed=8).scaled(0.8 * half))
    scan = peers.make_slice(33, 40, 0.0)
    for turned in (scan.truth[:, ::-1], scan.truth[:, :, ::-1], scan.truth.transpose(0, 2, 1)):
        assert scan.error(turned) > 0.75
    assert scan.error(0 * scan.truth) == pytest.approx(1)
    found = run(scan)
    for curve in found.values():
        assert min(curve.errors) < 0.75
        assert np.all(np.diff(curve.seconds) >= 0)


def test_the_table_has_the_least_error_of_each() -> None:
    found = {"few": {"a": peers.Curve([0.5, 0.25, 0.3], [1.0, 2.0, 3.0])}, "many": {"a": peers.Curve([0.1], [0.5])}}
    assert peers.rows(found)[2] == "| a | 0.2500 (2, 2.00 s) | 0.1000 (1, 0.50 s) |"
