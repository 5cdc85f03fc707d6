"""Correction of a photograph's pose by renders of a model.

Conventions. A motion has six numbers [pixel]: a rotation about the camera's position and a translation, both in the axes of the
world, each in units that move the image of the subject by about a pixel.

Source: Levenberg 1944, Marquardt 1963 (damped least squares); derivatives are differences of renders.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mivol.photos.camera import Camera, move_camera

ITERATIONS = 4
"""Iterations of an alignment: seven renders each."""

STEP = 0.5
"""Difference of a motion for derivatives [pixel]."""

DAMPING = 0.01, 0.1, 10.0
"""First damping, relative to the diagonal, and its factors after a better and a worse step."""


def align_camera(
    render: Callable[[Camera], np.ndarray], camera: Camera, image: np.ndarray, mask: np.ndarray | None, distance: float
) -> Camera:
    """Return the camera whose render is nearest to a photograph by least squares, searched near the given pose.

    Args:
        render: view (H, W, 3) of a model from a camera.
        camera: camera of the photograph.
        image: the photograph (H, W, 3).
        mask: (H, W) bool, False for pixels that do not count; None: all pixels count.
        distance: of the subject from the camera [length].
    """
    unit = np.repeat([1.0, distance], 3) / camera.K[0, 0]
    used = np.ones(image.shape[:2], bool) if mask is None else mask

    def error(motion: np.ndarray) -> np.ndarray:
        move = motion * unit
        return (render(move_camera(camera, move[:3], move[3:])) - image)[used].ravel()

    motion, damping = np.zeros(6), DAMPING[0]
    residual = error(motion)
    for _ in range(ITERATIONS):
        slopes = np.stack([(error(motion + STEP * axis) - residual) / STEP for axis in np.eye(6)], axis=1)
        normal, gradient = slopes.T @ slopes, slopes.T @ residual
        if not np.trace(normal) > 0:  # the model shows nothing that a motion would change
            break
        diagonal = np.diag(np.maximum(np.diag(normal), 1e-6 * np.trace(normal)))
        tried = motion - np.linalg.solve(normal + damping * diagonal, gradient)
        moved = error(tried)
        is_better = moved @ moved < residual @ residual
        motion, residual = (tried, moved) if is_better else (motion, residual)
        damping *= DAMPING[1] if is_better else DAMPING[2]
    move = motion * unit
    return move_camera(camera, move[:3], move[3:])
