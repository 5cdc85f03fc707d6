"""Points and Gaussians in tiles of pixels, composited front to back, with derivatives.

    splatter = Splatter(width, height, degree)
    picture, kept = splatter.forward(tensors_of(gaussians), camera)
    gradient, statistics = splatter.backward(kept, d_picture)

One picture passes through three modules: ``projection`` makes an ellipse in the image of each Gaussian (EWA splatting),
``tile_lists`` lists for each tile of 8 x 8 pixels the ellipses that reach it, nearest first, and ``compositing`` adds them up,
forward and backward. ``splatter`` records the kernels of all three once, and launches them for any cloud and any camera.
"""

from mivol.splatting.splatter import Kept, Splatter, Statistics, tensors_of

__all__ = ["Kept", "Splatter", "Statistics", "tensors_of"]
