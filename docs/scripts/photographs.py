"""A radiance field from photographs, and the field on a floor in a scene."""
import mivol
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")

settings = {"field.preset": "tiny", "photos.background": "white", "show.frames": 8}
field = mivol.fit_photographs("photographs", "field", settings)
T = mi.ScalarTransform4f
medium = {"type": "mivol_medium", "emission": {"type": "mivol_sh", "filename": "field/field.npz"}}
box = {"type": "cube", "to_world": T(field.to_world).translate(0.5).scale(0.5), "bsdf": {"type": "null"}, "interior": medium}
floor = {"type": "rectangle", "to_world": T().translate([0, 0, -1.1]).scale(3), "bsdf": {"type": "diffuse"}}
camera = {"type": "perspective", "fov": 40, "to_world": T().look_at([3, 2, 2], [0, 0, 0], [0, 0, 1])}
parts = {"box": box, "floor": floor, "camera": camera, "light": {"type": "constant"}, "integrator": {"type": "mivol"}}
mi.Bitmap(mi.render(mi.load_dict({"type": "scene", **parts}), spp=16)).write("scene.exr")
