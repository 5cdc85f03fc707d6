"""``params.update()`` of a ``gridvolume`` cannot be recorded: it reads the largest value back."""

import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
volume = mi.load_dict({"type": "gridvolume", "grid": mi.VolumeGrid(dr.ones(mi.TensorXf, (4, 4, 4, 1)).numpy()), "raw": True})
params = mi.traverse(volume)


@dr.freeze
def step(volume: mi.Volume, data: mi.TensorXf) -> mi.Float:
    params["data"] = data
    params.update()
    it = dr.zeros(mi.Interaction3f, 4)
    it.p = mi.Point3f(0.5)
    return volume.eval_1(it)


try:
    for k in range(3):
        dr.eval(step(volume, mi.TensorXf(dr.full(mi.Float, 1.0 + k, 64), (4, 4, 4, 1))))
except RuntimeError as error:
    print("as known:", str(error.__cause__ or error).splitlines()[-1])
else:
    raise SystemExit("gone: the update was recorded")
