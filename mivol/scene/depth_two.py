from __future__ import annotations
import numpy as np
ALBEDOS = (0.2, 0.5, 0.75, 0.9, 0.99)
TAUS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
TABLES = {}
def depth_two_error(a,t,l): return 0.0
