r"""A model of the time of a step, or of a reference, against the number of workers.

Conventions. The owner has one network connection: it sends each worker the inputs of a step and receives its answer, one after
another. Workers compute at the same time. With B units of work of t seconds, W workers (at most B of them have work), S bytes
to and from a worker, latency l and bandwidth b, and s seconds of the owner alone,

.. math:: T(W) = s + \lceil B/W \rceil\, t + W\,(l + S/b).

The smallest time is near :math:`W = \sqrt{B t / (l + S/b)}`. If units stream (batches of references need no common step),
messages overlap with the work, and the larger of both counts:

.. math:: T(W) = s + \max(\lceil B/W \rceil\, t,\; B\,(l + S/b)).
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Workload:
    """The work of a step or a reference.

    Attributes:
        name: for tables.
        units: number of units of work, B.
        unit_seconds: time of a unit on a worker [s], t.
        message_bytes: bytes to and from a worker in a step, or of a unit that streams, S.
        owner_seconds: time of the owner alone [s], s.
        streams: whether units follow each other without a common step.
    """

    name: str
    units: int
    unit_seconds: float
    message_bytes: float
    owner_seconds: float = 0.0
    streams: bool = False


@dataclass(frozen=True)
class Network:
    """Connection of the owner.

    Attributes:
        latency: time of a message to a worker and its answer [s], l.
        bandwidth: [bytes/s], b.
    """

    latency: float
    bandwidth: float

    def message_seconds(self, size: float) -> float:
        """Time of a message of this size with its answer [s]."""
        return self.latency + size / self.bandwidth


def step_seconds(work: Workload, network: Network, workers: int) -> float:
    """T(W) [s]: time of a step, or of all units that stream.

    Args:
        work: the workload.
        network: the owner's connection.
        workers: W, 1 or more.
    """
    active = min(workers, work.units)
    compute = math.ceil(work.units / active) * work.unit_seconds
    message = network.message_seconds(work.message_bytes)
    if work.streams:
        return work.owner_seconds + max(compute, work.units * message)
    return work.owner_seconds + compute + active * message


def best_workers(work: Workload, network: Network) -> int:
    """The smallest number of workers with the smallest time."""
    return min(range(1, work.units + 1), key=lambda workers: (step_seconds(work, network, workers), workers))


def say_limit(work: Workload, network: Network) -> str:
    """What stops the scaling, in words."""
    best = best_workers(work, network)
    message = network.message_seconds(work.message_bytes)
    if work.streams and work.units * message >= math.ceil(work.units / best) * work.unit_seconds:
        return f"{best} workers: the owner receives images one after another"
    if best == work.units:
        return f"{best} workers: no more units"
    if math.ceil(work.units / best) == 1:
        return f"{best} workers: a unit is not divided"
    share = "bytes" if work.message_bytes / network.bandwidth > network.latency else "latency"
    return f"{best} workers: {share} of the messages, one worker after another"
