"""The width of an input is a literal in a recording: a replay with another width gives a wrong result without a word."""

import drjit as dr
from drjit.llvm.ad import Float, UInt32


@dr.freeze
def last_index(x: Float) -> UInt32:
    return dr.arange(UInt32, dr.width(x)) + UInt32(dr.width(x))


found = [int(dr.max(last_index(dr.arange(Float, n)))[0]) for n in (8, 16, 32, 64)]
expected = [2 * n - 1 for n in (8, 16, 32, 64)]
if found == expected:
    raise SystemExit("gone: the widths were followed")
print("as known: found", found, "expected", expected)
