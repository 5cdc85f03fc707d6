"""Sessions kept for the next integrator, so that a loop with a new integrator in each step replays earlier recordings.

Conventions. An integrator takes over the session of a freed integrator with equal settings that has rendered the same scene.
Integrators that live at the same time have sessions of their own. Mitsuba's objects take no weak references, so a kept scene is
held, and released at the next call of this module in which nobody else holds the scene: an integrator renders or is freed.
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
"""Most pairs of a session and a scene that are kept."""

@dataclass
class _KeptSession:
    """A session, the integrator that has it, and a scene that the session has rendered."""

    session: Session
    owner: ref[mi.Integrator]
    scene: mi.Scene


# The last has rendered last.
_kept: list[_KeptSession] = []
atexit.register(_kept.clear)


def take_session(integrator: mi.Integrator, session: Session, scene: mi.Scene) -> Session:
    """The session by which an integrator renders a scene: its own session, or a kept one if its own has rendered nothing.

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
    """Release the scenes that nobody else holds: each has one reference from each entry, and one of the call that counts."""
    own = Counter(id(kept.scene) for kept in _kept)
    _kept[:] = [kept for kept in _kept if sys.getrefcount(kept.scene) > own[id(kept.scene)] + 1]


def _free_scenes(_: ref[mi.Integrator]) -> None:
    """Release scenes when an integrator is freed, but not in the middle of a trace: Dr.Jit would abort the process."""
    if not dr.flag(dr.JitFlag.SymbolicScope) and not dr.flag(dr.JitFlag.FreezingScope):
        _release_scenes()
