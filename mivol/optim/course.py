"""What a fit goes through: how many iterations, how the steps shrink, what happens between them."""

from __future__ import annotations

from dataclasses import dataclass, field

from mivol.optim.events import Event
from mivol.optim.schedules import Constant, Schedule


@dataclass(frozen=True)
class Course:
    """What a fit goes through.

    Attributes:
        iterations: at most so many.
        schedule: factor on the learning rates.
        events: what happens between iterations.
    """

    iterations: int
    schedule: Schedule = field(default_factory=Constant)
    events: tuple[Event, ...] = ()
