"""A recorded kernel that only gathers is replayed with too few lanes: Dr.Jit guesses their number by the sizes of tables."""

import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
sky = {"type": "envmap", "bitmap": mi.Bitmap(dr.ones(mi.TensorXf, (8, 16, 3)))}
scene = mi.load_dict({"type": "scene", "sky": sky, "spot": {"type": "spot"}})
LANES = 65536


@dr.freeze
def shine(scene: mi.Scene) -> mi.Float:
    lane = dr.arange(mi.UInt32, LANES)
    it = dr.zeros(mi.Interaction3f, LANES)
    emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), lane % 2)
    return dr.sum(emitter.sample_direction(it, mi.Point2f(mi.Float(lane) / LANES, 0.5), True)[1])


found = [dr.width(shine(scene)) for _ in range(3)]
if found == [LANES] * 3:
    raise SystemExit("gone: all lanes were computed")
print("as known: lanes", found, "expected", LANES)
