"""Points and Gaussians in tiles of pixels, composited front to back, with derivatives.

    splatter = Splatter(width, height, degree)
    image, cache = splatter.forward(to_tensors(gaussians), camera)
    gradient, statistics = splatter.backward(cache, d_image)

An image passes through three modules. ``projection`` projects each Gaussian to an ellipse in the image (EWA splatting),
and lists the ellipses in each tile of 8 x 8 pixels, nearest first. ``compositing`` adds up the ellipses, forward and backward.
``splatter`` records the kernels of these modules once, and launches them for every cloud and camera.
"""

from mivol.splatting.splatter import ScreenStatistics, Splatter, SplatterCache, to_tensors

__all__ = ["SplatterCache", "Splatter", "ScreenStatistics", "to_tensors"]
