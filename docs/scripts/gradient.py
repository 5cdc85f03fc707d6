"""How a picture's brightness depends on each voxel of a smoke."""
import mivol
import drjit as dr
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")                       # or cuda_ad_rgb

density = mi.TensorXf(mivol.make_procedural("tangle", (40, 40, 40), seed=2, peak=6.0))
fog = {"type": "mivol_medium", "albedo": 0.8, "sigma_t": {"type": "mivol_voxels", "data": density}}
T = mi.ScalarTransform4f()
smoke = {"type": "cube", "to_world": T.scale(0.5).translate(1), "bsdf": {"type": "null"}, "interior": fog}
camera = {"type": "perspective", "fov": 30, "to_world": T.look_at([2.5, 2, 3], [0.5] * 3, [0, 1, 0])}
scene = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "camera": camera, "smoke": smoke})
params = mi.traverse(scene)
dr.enable_grad(params["smoke.interior_medium.sigma_t.data"])
image = mi.render(scene, params, integrator=mi.load_dict({"type": "mivol", "max_depth": 6}), spp=4)
dr.backward(dr.mean(image, axis=None))
