"""A density from pictures, by a loss of your own."""
from pathlib import Path
import mivol
import drjit as dr
import mitsuba as mi
import numpy as np
mi.set_variant("llvm_ad_rgb")

def loss(image: mi.TensorXf, picture: mi.TensorXf) -> mi.TensorXf:
    return dr.mean(dr.abs(image - picture) / (picture + 0.05), axis=None)

density = mivol.Parameter("cube.interior_medium.sigma_t.data", domain=(0, 50), lr=0.1)
problem = mivol.Problem("scene.xml", sorted(Path("pictures").glob("*.exr")), [density], loss=loss)
fit = mivol.optimize(problem, mivol.Adam(), 40)
mivol.write_volume("density.vol", np.array(fit.values()[density.name]))
