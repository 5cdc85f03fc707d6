"""A scene of Mitsuba in a reference cycle, freed by Python's collector while ``dr.freeze`` records, ends the process."""

import subprocess
import sys

SCRIPT = """
import gc
import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
gc.disable()
cycle = [mi.load_dict({"type": "scene", "wall": {"type": "rectangle"}})]
cycle.append(cycle)
del cycle


@dr.freeze
def step(x):
    gc.collect()
    return x + 1


dr.eval(step(dr.arange(mi.Float, 5)))
"""

done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=120, check=False)
if "this function cannot be recorded" not in done.stderr:
    raise SystemExit(f"gone: the process ended with {done.returncode} {done.stderr[-300:]}")
print("as known: the process ends with", done.returncode)
