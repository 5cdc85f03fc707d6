"""A radiance field from photographs, and the field on a floor in a scene."""
import mivol
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")

settings = {"field.preset": "tiny", "photos.background": "white", "show.frames": 8}
field = mivol.fit_photographs("photographs", "field", settings)
T = mi.ScalarTransform4f
medium = {"type": "mivol_medium", "emission": {"type": "mivol_sh", "filename": "field/field.npz"}}
place, lower = T(field.to_world).translate(0.5).scale(0.5), T().translate([0, 0, -1.1]).scale(3)
box = {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": medium}
floor = {"type": "rectangle", "to_world": lower, "bsdf": {"type": "diffuse"}}
camera = {"type": "perspective", "fov": 40, "to_world": T().look_at([3, 2, 2], [0, 0, 0], [0, 0, 1])}
light = {"integrator": {"type": "mivol"}, "sky": {"type": "constant"}}
scene = mi.load_dict({"type": "scene", "box": box, "floor": floor, "camera": camera, **light})
mi.Bitmap(mi.render(scene, spp=16)).write("scene.exr")
