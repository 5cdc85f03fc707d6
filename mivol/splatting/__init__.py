"""Points and Gaussians in tiles of pixels, composited front to back, with derivatives.

    splatter = Splatter(width, height, degree)
    picture, kept = splatter.forward(to_tensors(gaussians), camera)
    gradient, statistics = splatter.backward(kept, d_picture)

One picture passes through three modules: ``projection`` makes an ellipse in the image of each Gaussian (EWA splatting),
``tile_lists`` lists for each tile of 8 x 8 pixels the ellipses that reach it, nearest first, and ``compositing`` adds them up,
forward and backward. ``splatter`` records the kernels of all three once, and launches them for any cloud and any camera.
"""

from mivol.splatting.splatter import Splatter, SplatterCache, Statistics, to_tensors

__all__ = ["SplatterCache", "Splatter", "Statistics", "to_tensors"]
