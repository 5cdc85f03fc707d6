"""Photographs whose cameras move with a fit.

Conventions. From time to time each camera takes a damped least-squares step (:class:`mivol.photos.camera.Motions`) on random
tiles of its photograph, while the model is constant. Between these corrections the model is fitted, while the cameras are
constant.

A turn and a shift can look alike, so only their sum is known. A prior on both keeps each small. The scene then stays
where the held-out photographs see it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from mivol.optim.photographs.ray_batches import RayBatches
from mivol.photos import Camera
from mivol.photos.camera import Motions, motion_unit, move_camera

TILES = 64
"""Tiles of a photograph that correct its pose: 1024 pixels for six numbers."""

EXPECTED = 3.0
"""Expected size of each number of a motion [pixel]."""

FindErrors = Callable[[RayBatches, np.ndarray, np.ndarray], np.ndarray]
"""Photographs, numbers of some views, first pixels of their tiles (views, tiles, 2) -> differences of renders and photographs
(views, n)."""


@dataclass
class MovingCameras:
    """Photographs with cameras that move.

    Attributes:
        given: the photographs with their given poses.
        distance: of the subject from the cameras [length].
        motions: motion of each camera.
        posed: the photographs with the moved cameras.
    """

    given: RayBatches
    distance: float
    motions: Motions = field(init=False)
    posed: RayBatches = field(init=False)

    def __post_init__(self) -> None:
        self._units = np.array([motion_unit(camera, self.distance) for camera in self.given.cameras])
        self.set_motions(Motions.none(len(self._units)))

    def set_motions(self, motions: Motions) -> None:
        """Move all cameras from their given poses."""
        self.motions = motions
        self.posed = self.given.with_cameras(self._move(np.arange(len(self._units)), motions.motion))

    def table(self) -> np.ndarray:
        """Motions (photographs, 6) in the axes of the world: rotation vectors about the cameras [rad], and shifts [length]."""
        return self.motions.motion * self._units

    def _move(self, views: np.ndarray, motion: np.ndarray) -> list[Camera]:
        """All given cameras, some after motions (views, 6) [pixel]."""
        cameras = list(self.given.cameras)
        for view, move in zip(views, motion * self._units[views], strict=True):
            cameras[view] = move_camera(cameras[view], move[:3], move[3:])
        return cameras

    def correct(self, find: FindErrors, shrink: int, together: int, rng: np.random.Generator) -> float:
        """Correct each pose by a step of least squares.

        Args:
            find: compares the model with photographs.
            shrink: size of the photographs.
            together: most views in a call of ``find``.
            rng: draws the pixels.

        Returns:
            Root mean square of the motions so far, of their six numbers together [pixel].
        """
        count, parts = len(self._units), []
        for views in np.array_split(np.arange(count), -(-count // together)):
            corner = self.given.draw_corners(shrink, views, TILES, rng)

            def error(motion: np.ndarray, views: np.ndarray = views, corner: np.ndarray = corner) -> np.ndarray:
                return find(self.given.with_cameras(self._move(views, motion)), views, corner)

            parts.append(Motions(self.motions.motion[views], self.motions.damping[views]).improve(error, EXPECTED))
        motion, damping = (np.concatenate([getattr(part, name) for part in parts]) for name in ("motion", "damping"))
        self.set_motions(Motions(motion, damping))
        return float(np.sqrt((motion**2).sum(axis=1).mean()))
