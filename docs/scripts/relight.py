"""That density under another light."""
import mivol
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")

scene = mi.load_file("scene.xml")
params = mi.traverse(scene)
params["cube.interior_medium.sigma_t.data"] = mi.TensorXf(mivol.read_volume("density.vol").values)
params["cube.interior_medium.albedo.value.value"] = 0.9
params["sky.radiance.value"] = mi.Color3f(1.0, 0.5, 0.2)
params.update()
image = mi.render(scene, sensor=0, integrator=mi.load_dict({"type": "mivol", "max_depth": 6}), spp=64)
mi.Bitmap(image).write("relit.exr")
