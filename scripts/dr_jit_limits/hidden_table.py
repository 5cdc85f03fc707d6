"""A call of a stock ``tabphase``, directly or by a pointer, cannot be recorded: Mitsuba hides its table from Dr.Jit."""

import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
phase = mi.load_dict({"type": "tabphase", "values": "0.2, 0.5, 0.9"})


@dr.freeze
def evaluate(phase: mi.PhaseFunction, cosine: mi.Float) -> mi.Float:
    it = dr.zeros(mi.MediumInteraction3f, dr.width(cosine))
    it.wi = mi.Vector3f(0, 0, 1)
    wo = mi.Vector3f(dr.sqrt(1 - cosine * cosine), 0, cosine)
    return phase.eval_pdf(mi.PhaseFunctionContext(None), it, wo)[1]


try:
    dr.eval(evaluate(phase, mi.Float(-0.5, 0.5)))
except RuntimeError as error:
    print("as known:", str(error.__cause__ or error).splitlines()[-1])
else:
    raise SystemExit("gone: the call was recorded")
