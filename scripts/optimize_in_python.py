"""A reconstruction in twenty lines of Python: the demo scene, a known volume, sixteen views, Gauss-Newton. No command line."""

from __future__ import annotations

from pathlib import Path

import mivol  # noqa: F401  (chooses the LLVM library; call it before the first variant)
from mivol.fields.procedural import make_procedural
from mivol.optim.loop import reconstruct
from mivol.optim.parameters import Parameter
from mivol.optim.priors import HuberTotalVariation
from mivol.optim.scenes.scene_problem import SceneProblem
from mivol.optim.scenes.views import View
from mivol.optim.second_order import GaussNewton
from mivol.scene.sensors import Hemisphere

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
key = "matter.interior_medium.sigma_t.data"
scene = mi.load_file(str(Path(__file__).parents[1] / "scenes/demo/scene.xml"))
sensors = [mi.load_dict(s) for s in Hemisphere(count=16, lowest=-90, width=32, height=32).sensors(scene)]
params = mi.traverse(scene)

truth = make_procedural("tangle", (20, 20, 20), seed=2, peak=6.0)
params[key] = mi.TensorXf(truth)
params.update()
views = [View(f"view {i}", s, mi.render(scene, sensor=s, spp=256, seed=i)) for i, s in enumerate(sensors)]

params[key] = mi.TensorXf(np.full((20, 20, 20, 1), 0.1, dtype=np.float32))
params.update()
prior = HuberTotalVariation(weight=3e-5, edge=1.0)
parameter = Parameter(key, domain=(0, np.inf), priors=(prior,))
problem = SceneProblem(scene, views, [parameter], mi.load_dict({"type": "mivol"}), spp=16)
fit = reconstruct(problem, GaussNewton(), 8, observer=lambda fit: print(fit.history[-1]))

found = np.asarray(fit.values()[key])
print(f"relative error of the volume: {np.linalg.norm(found - truth) / np.linalg.norm(truth):.3f}")
