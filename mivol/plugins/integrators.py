"""<integrator type="mivol">: images of volumes that absorb, scatter and emit, and their derivatives."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from mivol.errors import MivolError
from mivol.scene import session
from mivol.scene.session import Session
from mivol.transport.path.estimators import Settings


class MivolIntegrator(mi.ad.integrators.common.ADIntegrator):
    """``<integrator type="mivol">``: volumes rendered by exact optical depths and free flights.

    Replaces ``prbvolpath`` for ``mivol_medium``, ``homogeneous`` and ``heterogeneous`` media.

    Parameters:
        max_depth: counted as in ``volpath``. 1: emitters seen through media; 2: surfaces lit directly, and media that scatter
            once; n: n - 1 scatterings; -1: no limit. Default 6 as in ``prbvolpath``; ``volpath`` has -1. Without a given depth,
            a warning says if scattering order 5 still carries more than 1 % of the light.
        rr_depth: depth from which Russian roulette may end a path. Default 5.
        hide_emitters: do not show emitters to the camera. Default false.
        deterministic: scattered light by quadrature along the ray, without noise; at depth 2, for point, spot and directional
            lights. Derivatives are still sampled. The quadrature has a small error (docs/limits.md). Volumes known at points
            (``mivol_hash``) are integrated without noise too. Default false.
        shadows: exact; estimated: unbiased, from a few look-ups, in images (gradients walk every cell of dense grids); grid:
            with ``deterministic``, looked up in a lattice of optical depths; auto: exact, or estimated for fine grids and in
            gradients by thin grids, and in images of media that scatter several times one exact shadow ray a path, chosen
            without bias by a table. Default auto.
        media_light: how light emitted by media finds scattering points. drawn: points in media are sampled, besides chance
            hits; met: by chance hits only; auto: the method with the smaller error in a small preview. Default auto.
        near_light: where emitters with a position (point, spot, area) light media that scatter several times. segments: every
            segment of a path draws a distance by the emitter; vertices: at collisions; auto: along segments if an emitter lies
            inside a medium, or near a medium and a small preview finds less noise; for derivatives by a grid, then only if the
            grid is dense. Default auto.
        aovs: comma-separated list of tau, tau.R, tau.G, tau.B, alpha, depth; appended to the colours in the given order.
    """

    def __init__(self, props: mi.Properties) -> None:
        settings = Settings(
            _read(props, "max_depth", 6),
            _read(props, "rr_depth", 5),
            _read(props, "hide_emitters", False),
            _read(props, "deterministic", False),
            _read(props, "shadows", "auto"),
            _read(props, "media_light", "auto"),
            _read(props, "near_light", "auto"),
        )
        self.session = Session(settings, _read(props, "aovs", ""), is_depth_given="max_depth" in props)
        super().__init__(props)

    def aov_names(self) -> list[str]:
        return list(self.session.aovs)

    def render(
        self,
        scene: mi.Scene,
        sensor: int | mi.Sensor = 0,
        seed: int = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        return self._session_for(scene).render(scene, sensor, seed, spp, develop, evaluate)

    def render_forward(
        self, scene: mi.Scene, params: Any, sensor: int | mi.Sensor = 0, seed: int = 0, spp: int = 0
    ) -> mi.TensorXf:
        return self._session_for(scene).render_forward(scene, sensor, seed, spp)

    def render_backward(
        self, scene: mi.Scene, params: Any, grad_in: mi.TensorXf, sensor: int | mi.Sensor = 0, seed: int = 0, spp: int = 0
    ) -> None:
        self._session_for(scene).render_backward(scene, grad_in, sensor, seed, spp)

    def sample(
        self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f, medium: mi.Medium = None, active: mi.Bool = True, **_: Any
    ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float], None]:
        # Integrators that nest this one call it as they call every ADIntegrator: by keywords, among them ``mode`` and
        # ``state_in``, and without the sensor's medium; they expect a state for a second pass, which mivol does not need.
        return *self.session.sample(scene, sampler, ray, active), None

    def _session_for(self, scene: mi.Scene) -> Session:
        """The session by which this integrator renders a scene."""
        self.session = session.take_session(self, self.session, scene)
        return self.session

    def to_string(self) -> str:
        return repr(self.session)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        pass


EXPECTED = {int: "a whole number", bool: "true or false", str: "a text"}


def _read(props: mi.Properties, name: str, default: int | bool | str) -> int | bool | str:
    """Read a parameter of the same type as its default. (Mitsuba's own ADIntegrator accepts a max_depth of 2.5.)

    Raises:
        MivolError: a value of another type.
    """
    value = props.get(name, default)
    if type(value) is not type(default):
        expected = f"{EXPECTED[type(default)]} is expected, such as {default!r}"
        raise MivolError(f"{name} of the integrator mivol is {value!r}; {expected}.")
    return value


mi.register_integrator("mivol", MivolIntegrator)
