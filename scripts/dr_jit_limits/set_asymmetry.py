"""No call of a phase function is recorded while a stock ``hg`` lives whose ``g`` was set through ``params.update()``."""

import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
phases = [mi.load_dict({"type": name}) for name in ("hg", "isotropic")]
params = mi.traverse(phases[0])
params["g"] = dr.opaque(mi.Float, 0.5)
params.update()
pointers = mi.PhaseFunctionPtr(phases)


@dr.freeze
def evaluate(phases: mi.PhaseFunctionPtr, cosine: mi.Float) -> mi.Float:
    it = dr.zeros(mi.MediumInteraction3f, dr.width(cosine))
    it.wi = mi.Vector3f(0, 0, 1)
    wo = mi.Vector3f(dr.sqrt(1 - cosine * cosine), 0, cosine)
    return phases.eval_pdf(mi.PhaseFunctionContext(None), it, wo)[1]


try:
    for k in range(3):
        dr.eval(evaluate(pointers, mi.Float(-0.5 + 0.01 * k, 0.5)))
except RuntimeError as error:
    print("as known:", str(error.__cause__ or error).splitlines()[-1])
else:
    raise SystemExit("gone: the call was recorded")
