"""Volumes of the studies: the smoke of the Mitsuba tutorial, a CT scan, a cloud, sparse threads, and made-up volumes.

Conventions. Values are (Z, Y, X) float32 [1/length] at voxel centres of the box [-1, 1]^3. Files come from MIVOL_DATA
(default: shared/data beside the checkout). A made-up volume of the same size replaces a missing file, and ``origin``, which
the JSON holds, says so.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import mitsuba as mi
import numpy as np

from mivol.fields.procedural import make_procedural
from mivol.files import read_volume
from mivol.optim.events import upsample

__all__ = [
    "CHECKOUT",
    "DATA",
    "TO_WORLD",
    "TUTORIAL_SCALE",
    "Extinction",
    "as_dense_as_smoke",
    "ct_scan",
    "fine_smoke",
    "les_cloud",
    "made_up",
    "smoke",
    "threads_in_space",
]

CHECKOUT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("MIVOL_DATA", CHECKOUT.parent / "shared" / "data"))

TO_WORLD = np.array([[2, 0, 0, -1], [0, 2, 0, -1], [0, 0, 2, -1], [0, 0, 0, 1]], np.float64)
"""Transform from the unit cube to [-1, 1]^3, the box of every volume, as in the tutorial."""

TUTORIAL_SCALE = 40.0
"""Factor on the smoke in the tutorial; optical depths reach 65."""


class Extinction(NamedTuple):
    """An extinction (Z, Y, X) float32 [1/length] and its origin."""

    values: np.ndarray
    origin: str

    def __str__(self) -> str:
        return f"{'x'.join(map(str, self.values.shape[::-1]))}, {self.origin}"


def smoke() -> Extinction:
    """The smoke of the tutorial at its density, or made-up smoke of the same size."""
    path = DATA / "volumes_vol" / "tutorials_volume.vol"
    if path.is_file():
        return Extinction(np.float32(TUTORIAL_SCALE) * read_volume(path, frame="unit").values[..., 0], "Mitsuba tutorial, x 40")
    return made_up((53, 45, 44), peak=1.85 * TUTORIAL_SCALE)


def fine_smoke(res: int) -> Extinction:
    """The smoke upsampled to res^3 voxels."""
    coarse = smoke()
    fine = upsample(mi.TensorXf(np.ascontiguousarray(coarse.values[..., None])), (res,) * 3)
    return Extinction(np.array(fine)[..., 0], f"{coarse.origin}, upsampled")


def made_up(shape: tuple[int, int, int], peak: float, why: str = "no data folder") -> Extinction:
    """Made-up soft blobs and filaments (Z, Y, X) with the seed 0; ``why`` is the reason in their origin."""
    return Extinction(make_procedural("tangle", shape, 0, peak)[..., 0], f"procedural ({why})")


def ct_scan(res: int) -> Extinction:
    """The CT scan of a bonsai at 256^3 voxels, 0 to 2 [1/length]; a made-up volume at another resolution."""
    path = DATA / "ct_mri" / "bonsai.vti"
    if res == 256 and path.is_file():
        values = read_volume(path, frame="unit").values[..., 0]
        return Extinction(values * np.float32(2 / values.max()), "bonsai CT")
    return made_up((res,) * 3, 2.0, "no data folder" if res == 256 else "quick")


def threads_in_space(res: int) -> Extinction:
    """Thin curved threads in 1 % of res^3 voxels; all other voxels are exactly 0."""
    rng = np.random.default_rng(0)
    values = np.zeros((res,) * 3, np.float32)
    offsets = np.stack(np.meshgrid(*[np.arange(-3, 4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    stamp = np.maximum(0, 1 - np.sum(offsets**2, axis=1) / 10).astype(np.float32)
    offsets, stamp = offsets[stamp > 0], stamp[stamp > 0]
    s = np.linspace(0, 2 * np.pi, 2 * res)[:, None]
    while np.count_nonzero(values) < 0.01 * values.size:
        a, b, c = rng.uniform(-0.3, 0.3, (3, 3))
        curve = 0.5 + a * np.cos(s) + b * np.sin(s) + c * np.cos(2 * s) / 2
        nodes = np.clip(np.rint(curve * res).astype(int)[:, None] + offsets, 0, res - 1)
        np.maximum.at(values, tuple(nodes.reshape(-1, 3).T), np.tile(stamp, len(curve)))
    return Extinction(20 * values, f"made-up threads, {np.count_nonzero(values) / values.size:.1%} of the voxels not 0")


def les_cloud() -> Extinction:
    """A cloud of a large-eddy simulation, stretched to the box; its optical depth along the vertical stays the same."""
    path = DATA / "clouds_les" / "rico32x37x26.txt"
    if not path.is_file():
        return made_up((26, 37, 32), TUTORIAL_SCALE)
    cloud = read_volume(path)
    height = np.linalg.norm(cloud.to_world[:3, 2])
    return Extinction(cloud.values[..., 0] * np.float32(height / 2), "LES cloud (RICO), stretched to a cube")


def as_dense_as_smoke(volume: Extinction) -> Extinction:
    """Scale a volume to the largest extinction of the smoke, and empty its outermost voxels.

    Mitsuba continues rays (1 + |p|) 9e-5 behind a boundary. A medium that touches the boundary loses this skin, which holds 2 %
    of the light at such an extinction (measured by quadrature in float64, which agrees with mivol).
    """
    values = np.pad(volume.values[1:-1, 1:-1, 1:-1], 1)
    return Extinction(values * np.float32(smoke().values.max() / values.max()), f"{volume.origin}, as dense as the smoke")
