"""All optimisers by name."""

from __future__ import annotations

from mivol.optim.adam import Adam
from mivol.optim.gauss_newton import GaussNewton
from mivol.optim.lbfgs import Lbfgs
from mivol.optim.rmsprop import RMSprop
from mivol.optim.strategy import table

OPTIMISERS = table(Adam, RMSprop, Lbfgs, GaussNewton)
