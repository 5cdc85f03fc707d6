"""A function called by one instance and the same function called by two end the process, if one kernel computes both."""

import subprocess
import sys

SCRIPT = """
import mitsuba as mi
import drjit as dr

mi.set_variant("llvm_ad_rgb")
kept = []
for _ in range(2):
    kept.append(mi.load_dict({"type": "sphere"}))
    index = dr.opaque(mi.UInt32, 1, 4)
    kept.append(dr.reinterpret_array(mi.ShapePtr, index).surface_area())
dr.eval(kept[1], kept[3])
"""

done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=120, check=False)
if "invalid redefinition of function" not in done.stderr:
    raise SystemExit(f"gone: the process ended with {done.returncode} {done.stderr[-300:]}")
print("as known: LLVM refuses the kernel, and the process ends with", done.returncode)
