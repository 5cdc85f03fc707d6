"""Twenty computed scans in parallel light, and the column of their rotation axis: noise, rings, off-centre, region of interest,
air of .5 to 1, whole turns with the axis near the edge of the detector.

Pixels see the mean light of three parts of a column; no grid takes part. Flats and darks are simulated, so the whole way from
readings to the axis is under test.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mivol.tomography.geometry import ParallelBeam
from mivol.tomography.phantoms import random_ellipsoids, shepp_logan


@dataclass(frozen=True)
class AxisScan:
    """A computed scan: the axis lies ``offset`` columns beyond the middle, the object reaches ``radius`` columns from it.

    ``gains``: standard deviation of a column's factor that the flats do not have. ``air``: light of the views over the flats'.
    ``depth``: largest line integral.
    """

    offset: float
    radius: float = 44.0
    views: int = 90
    arc: float = 180.0
    columns: int = 120
    photons: float = 1e4
    gains: float = 0.0
    air: float = 1.0
    depth: float = 2.0
    head: bool = True
    rows: int = 2
    seed: int = 0

    @property
    def column(self) -> float:
        """Column of the axis."""
        return self.offset + (self.columns - 1) / 2

    def beam(self) -> ParallelBeam:
        """The beam, with pixels of 1."""
        angles = np.radians(self.arc) * np.arange(self.views) / self.views
        return ParallelBeam(angles, (self.rows, self.columns), 1.0, axis_offset=self.offset)

    def readings(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Views, flats and darks (n, rows, columns)."""
        rng = np.random.default_rng(self.seed)
        phantom = shepp_logan(half_width=self.radius / 0.92) if self.head else random_ellipsoids(40, self.seed + 7, self.radius)
        beam = self.beam()
        fine = replace(beam, detector=(self.rows, 3 * self.columns), pitch=(1.0, 1 / 3))
        y = phantom.project(fine)
        light = np.exp(-self.depth * y / y.max()).reshape(self.views, self.rows, self.columns, 3).mean(-1)
        pattern = self.photons * (1 + 0.2 * np.sin(np.arange(self.columns) / 7)) * np.ones((self.rows, 1))
        factor = 1 + self.gains * rng.normal(size=pattern.shape)
        counts = [rng.poisson(pattern * factor * self.air * light), rng.poisson(np.repeat(pattern[None], 10, 0))]
        dark = rng.normal(100, 2, (10, self.rows, self.columns))
        return (*(0.5 * c + rng.normal(100, 2, c.shape) for c in counts), dark)


AXIS_SCANS: dict[str, AxisScan] = {
    "head": AxisScan(0.3),
    "off-centre": AxisScan(11.4),
    "far off-centre": AxisScan(-14.2, radius=40),
    "blocks": AxisScan(-3.7, head=False),
    "much noise": AxisScan(2.6, photons=300),
    "much noise, blocks": AxisScan(-5.3, photons=300, head=False, seed=1),
    "few views": AxisScan(1.7, views=40, seed=2),
    "rings 2 %": AxisScan(4.4, gains=0.02, seed=3),
    "rings 5 %, off-centre": AxisScan(-9.1, gains=0.05, seed=4),
    "rings 2 %, noise": AxisScan(6.2, gains=0.02, photons=1000, head=False, seed=5),
    "air .9": AxisScan(1.3, air=0.9, seed=6),
    "air .7": AxisScan(-6.6, air=0.7, seed=7),
    "air .5, noise": AxisScan(3.9, air=0.5, photons=1000, head=False, seed=8),
    "region of interest": AxisScan(0.4, radius=90, depth=3, seed=9),
    "region of interest, off-centre": AxisScan(-12.3, radius=85, depth=3, head=False, seed=10),
    "region of interest, many views": AxisScan(5.2, radius=120, views=240, depth=3, seed=11),
    "region of interest, air .8": AxisScan(3.1, radius=90, depth=3, air=0.8, head=False, seed=12),
    "whole turn": AxisScan(2.8, arc=360, views=120, seed=13),
    "half acquisition, overlap 40": AxisScan(39.3, radius=90, arc=360, views=240, depth=3, seed=14),
    "half acquisition, overlap 16": AxisScan(-51.6, radius=100, arc=360, views=240, depth=3, head=False, seed=15),
}
