"""Sessions kept for the next integrator: a loop with a new integrator in each step replays earlier recordings.

Conventions. An integrator takes over the session of a freed integrator with equal settings and the same scene. Integrators in
memory at the same time have sessions of their own. Mitsuba's objects take no weak references, so the list holds each kept scene
until it has the only reference: this is checked when an integrator renders and when an integrator is freed.
"""

from __future__ import annotations

import atexit
import sys
from collections import Counter
from dataclasses import dataclass
from weakref import ref

import drjit as dr
import mitsuba as mi

from mivol.scene.session import Session

MAX_KEPT = 4
"""Most kept pairs of a session and a scene."""


@dataclass
class _KeptSession:
    """A session, its integrator, and a rendered scene."""

    session: Session
    owner: ref[mi.Integrator]
    scene: mi.Scene


# The last has rendered last.
_kept: list[_KeptSession] = []
atexit.register(_kept.clear)


def take_session(integrator: mi.Integrator, session: Session, scene: mi.Scene) -> Session:
    """The session by which an integrator renders a scene: a kept session in place of an own session without renders.

    The integrator of the scene itself lives as long as the scene, so its session is not kept.

    Args:
        integrator: the integrator, an object in Python.
        session: session of the integrator.
    """
    last = _kept[-1] if _kept else None
    if last is not None and last.session is session and last.scene is scene:
        return session
    _release_scenes()
    if scene.integrator() is integrator:
        return session
    if session.is_new:
        idle = [kept.session for kept in _kept if kept.owner() is None and kept.scene is scene]
        session = next((one for one in reversed(idle) if one.is_like(session)), session)
    owner = ref(integrator, _free_scenes)
    for kept in _kept:
        kept.owner = owner if kept.session is session else kept.owner
    others = [kept for kept in _kept if not (kept.session is session and kept.scene is scene)]
    _kept[:] = [*others[1 - MAX_KEPT :], _KeptSession(session, owner, scene)]
    return session


def _release_scenes() -> None:
    """Release the scenes without other owners: each has a reference from each entry, and one from the counting call."""
    own = Counter(id(kept.scene) for kept in _kept)
    _kept[:] = [kept for kept in _kept if sys.getrefcount(kept.scene) > own[id(kept.scene)] + 1]


def _free_scenes(_: ref[mi.Integrator]) -> None:
    """Release scenes when an integrator is freed, but not in the middle of a trace: Dr.Jit would abort the process."""
    if not dr.flag(dr.JitFlag.SymbolicScope) and not dr.flag(dr.JitFlag.FreezingScope):
        _release_scenes()
