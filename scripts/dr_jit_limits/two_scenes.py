"""A function of two scenes is recorded again in its third call: the first replay joins the arrays over the same memory."""

import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
floor = mi.load_dict({"type": "rectangle"})
first, second = (mi.load_dict({"type": "scene", "floor": floor}, optimize=False) for _ in range(2))


@dr.freeze
def step(first: mi.Scene, second: mi.Scene, x: mi.Float) -> mi.Float:
    return x + 1


counts = []
for k in range(6):
    dr.eval(step(first, second, dr.opaque(mi.Float, k)))
    counts.append(step.n_recordings)
print(counts)
if counts[-1] == 1:
    raise SystemExit("gone: the inputs were recorded once")
print("as known: the same inputs were recorded", counts[-1], "times")
