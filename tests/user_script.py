"""What a user of mivol may write, with types: read by mypy, never run. Every public name stands in it."""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

import mivol

print(mivol.__version__)


def loss(image: mi.TensorXf, picture: mi.TensorXf) -> mi.TensorXf:
    return dr.mean(dr.square(image - picture), axis=None)


scene: mi.Scene = mivol.load_scene("scene.xml", {"res": 3}).scene
facts: str = mivol.explain(scene, max_depth=4)
reference = mivol.render_reference("scene.xml", "ref.exr", max_depth=4, target_se=0.01, sensor={"type": "perspective"})
mean: np.ndarray = reference.mean
density = mivol.Parameter("cube.interior_medium.sigma_t.data", domain=(0, 50), lr=0.1)
problem = mivol.Problem(scene, "truth.xml", [density], loss=loss, spp=4)
problem = mivol.Problem({"type": "scene"}, ["a.exr", Path("b.exr"), mean, mi.TensorXf(mean)], [density.name])
for optimizer in (mivol.Adam(), mivol.Lbfgs(), mivol.GaussNewton(), mivol.RMSprop()):
    fit = mivol.optimize(problem, optimizer, 3, observer=lambda fit: print(fit.history[-1]["loss"]))
found: np.ndarray = np.array(fit.values()[density.name])

mivol.write_volume("a.vol", mivol.make_procedural("tangle", (8, 8, 8), seed=1, peak=2.0), metadata={"space": "RAS"})
volume = mivol.read_volume(Path("a.vol"))
print(volume.values.shape, volume.meta.get("space"))
mivol.write_volume("a.vdb", mivol.SparseVolumeData.from_dense(volume.values, volume.to_world))
mivol.write_grids("grids.vdb", {"density": volume})
print(mivol.convert_pbrt("cloud.pbrt", "cloud.xml"))
print(mivol.read_sparse_volume("a.vdb").bricks.shape)

photos = mivol.load_photos("photographs", background="white", held_out=8)
print(photos.views[0].camera.size)
mivol.write_field("field.npz", mivol.fit_photographs("photographs", "runs/field", {"field.preset": "tiny"}))
print(mivol.read_field("field.npz").to_world)

angles = np.linspace(0, np.pi, 60, endpoint=False)
grid = mivol.VoxelGrid((1, 64, 64), 1 / 32)
for geometry in (mivol.ParallelBeam(angles, (1, 64)), mivol.ConeBeam(angles, (1, 64), 500, 1000)):
    projector = mivol.Projector(geometry, grid)
    columns: np.ndarray = mivol.run_algotom("find_center_vo", np.ones((64, 1, 64)), angles, step=0.1)
    back = projector.T @ (projector @ np.zeros(grid.shape, np.float32))

cloud: mivol.PointCloud = mivol.read_points("points.ply")
mivol.write_points("points.npy", cloud)
gaussians: mivol.Gaussians = mivol.read_gaussians("gaussians.ply")
mivol.write_gaussians("more.ply", mivol.fit_gaussians("photographs", "runs/gaussians"))
splatter = mivol.Splatter(640, 480, gaussians.degree)

try:
    mivol.read_field("nowhere.npz")
except mivol.MivolError as error:
    print(error)
