"""Refusals: a scene or a setting that mivol cannot render raises with a sentence before a kernel runs."""

from __future__ import annotations

import difflib

import mitsuba as mi

from mivol.errors import MivolError
from mivol.scene.choices import choose_media_light, choose_near_light, is_scattering_visible, shares_cells
from mivol.scene.needs import Needs
from mivol.transport.line_integrals.aovs import AOVS
from mivol.transport.line_integrals.emission import MAX_PARTS, voxel_to_cell_ratio
from mivol.transport.media.grid_extinction import have_same_cells
from mivol.transport.path.estimators import Settings

SHADOWS = ("auto", "exact", "estimated", "grid")
"""Methods for shadows: ``exact``, from a ``grid`` (quadrature) or ``estimated`` (Monte Carlo images); ``auto`` chooses."""


MEDIA_LIGHT = ("auto", "drawn", "met")
NEAR_LIGHT = ("auto", "segments", "vertices")
"""Methods for the light of media: ``drawn`` (sampled, besides chance hits) or ``met`` (chance hits only); ``auto`` chooses."""


def parse_aovs(names: str) -> tuple[str, ...]:
    """Split a comma-separated list of AOVs.

    Raises:
        MivolError: a name missing from :data:`mivol.transport.line_integrals.aovs.AOVS`, or a repeated name.
    """
    listed = tuple(n.strip() for n in names.split(",") if n.strip())
    for name in listed:
        if name not in AOVS:
            near = difflib.get_close_matches(name, AOVS, 1, 0.0)[0]
            raise MivolError(f"aovs asks for {name!r}; mivol has {', '.join(AOVS)} (did you mean {near!r}?).")
        if listed.count(name) > 1:
            raise MivolError(f"aovs asks for {name!r} {listed.count(name)} times; a film has one channel of a name: ask once.")
    return listed


def check_scattering(needs: Needs, settings: Settings) -> None:
    """Refuse quadrature of light that scatters more than once."""
    if not is_scattering_visible(needs, settings):
        return
    medium = next(m.name for m in needs.media if m.is_scattering)
    if settings.deterministic and settings.scatterings > 1:
        raise MivolError(
            f"deterministic is set, the medium in {medium} scatters and max_depth is {settings.max_depth}; quadrature is for "
            "a single scattering: set max_depth to 2, or leave deterministic out."
        )


def check_emission_cells(needs: Needs, settings: Settings) -> None:
    """Refuse emission that varies faster than the integrated cells."""
    views = [view.by_quadrature() if settings.deterministic else view for view in needs.views]
    for facts, view in zip(needs.media, views, strict=True):
        if isinstance(view.emission_density, mi.Volume) and not have_same_cells(view.walked_lattice, view.emission_lattice):
            raise MivolError(
                f"the emission_density of the medium in {facts.name} has {view.emission_lattice.res} voxels (Z, Y, X) and its "
                f"extinction {view.walked_lattice.res}, or they lie in different places; it is summed in the cells of the "
                "extinction: give both the same resolution and to_world."
            )
        for name, volume in (("emission", view.emission), ("albedo", view.albedo)) if view.emission is not None else ():
            least = voxel_to_cell_ratio(volume, view) if isinstance(volume, mi.Volume) else 1.0
            if least * MAX_PARTS < 1 - 1e-4:  # the place of a stock grid is known to 5e-6
                led = any(p.lattice is not None for p in view.parts)
                whose, advice = ("extinction", ", or give it as a number") if led else ("emission_density", "")
                raise MivolError(
                    f"the {name} of the medium in {facts.name} varies over lengths of {least:.2g} of its {whose}'s cells, "
                    f"of which {MAX_PARTS} parts are integrated; resample the {whose} to smaller voxels{advice}."
                )


def check_placements(needs: Needs) -> None:
    """Refuse derivatives with respect to unsupported placements."""
    if needs.places:
        raise MivolError(
            f"the derivative of {needs.places[0]} was requested; mivol differentiates the placement of point, spot and "
            "directional lights only: use finite differences."
        )


def check_quadrature(needs: Needs, settings: Settings) -> None:
    """Refuse contradicting settings of shadows, and quadrature of unsuitable scenes."""
    if settings.shadows not in SHADOWS:
        raise MivolError(f"shadows is {settings.shadows!r}; {', '.join(SHADOWS[:-1])} or {SHADOWS[-1]} is expected.")
    if settings.shadows == "estimated" and settings.deterministic:
        raise MivolError("shadows is 'estimated' and deterministic is set: estimates are noise; set shadows to exact or grid.")
    if settings.shadows == "grid" and not settings.deterministic:
        raise MivolError("shadows is 'grid' without deterministic, and drawn light has exact shadows: set deterministic too.")
    if not settings.deterministic or not is_scattering_visible(needs, settings):
        return
    other = [name for name, kind in zip(needs.emitters, needs.emitter_kinds, strict=True) if kind != "delta"]
    if other:
        raise MivolError(
            f"deterministic is set and the scene has a {other[0]}; quadrature is for emitters of one position or direction "
            "(point, spot, directional): leave deterministic out."
        )
    further = [f"{medium.name} emits light too" for medium in needs.media if medium.emits]
    further += [f"the boundary {name} refracts light" for name in needs.refractive]
    if further:
        raise MivolError(
            f"deterministic is set, a medium scatters and {further[0]}; quadrature is for a medium that only scatters the "
            "light of emitters outside of refracting boundaries: leave deterministic out."
        )
    if len(needs.media) > 1 or not shares_cells(needs.views[0].by_quadrature()):
        medium, found = needs.media[0], f"the scene has {len(needs.media)} media"
        if len(needs.media) == 1:
            grids = f"{len(medium.resolutions)} grids of unlike cells" if medium.resolutions else "no grid"
            found = f"the medium in {medium.name} has {grids} in its extinction"
        raise MivolError(
            f"deterministic is set and {found}; quadrature is for one medium whose grids share their cells: leave "
            "deterministic out."
        )
    constant = next((part.name for part in needs.views[0].parts if part.is_constant), None)
    if settings.shadows == "grid" and constant is not None:
        raise MivolError(
            f"shadows is 'grid' and {constant} of the medium in {needs.media[0].name} is a constant, which may fill more than "
            "the cells that shadows are looked up in: set shadows to exact."
        )


def check_media_light(needs: Needs, settings: Settings) -> None:
    """Refuse the setting ``drawn`` for a scene in which the light of media cannot be sampled."""
    if settings.media_light not in MEDIA_LIGHT:
        known = f"{', '.join(MEDIA_LIGHT[:-1])} or {MEDIA_LIGHT[-1]}"
        raise MivolError(f"media_light is {settings.media_light!r}; {known} is expected.")
    draws, why = choose_media_light(needs, settings)
    if settings.media_light == "drawn" and why and not draws:
        raise MivolError(f"media_light is 'drawn', and {why[0].reason}: leave it at auto.")


def check_near_light(needs: Needs, settings: Settings, segment: str) -> None:
    """Refuse the setting ``segments`` for a scene in which segments cannot draw the light of near emitters."""
    if settings.near_light not in NEAR_LIGHT:
        known = f"{', '.join(NEAR_LIGHT[:-1])} or {NEAR_LIGHT[-1]}"
        raise MivolError(f"near_light is {settings.near_light!r}; {known} is expected.")
    draws, _, why = choose_near_light(needs, settings, segment)
    if settings.near_light == "segments" and why and not draws:
        raise MivolError(f"near_light is 'segments', and {why[0].reason}: leave it at auto.")


def check_bounded(needs: Needs, settings: Settings) -> None:
    """Refuse derivatives by emitters whose shadows may jump with the values of a field known at points, and rgb collisions with
    such a field beside light of Gaussians."""
    medium = next((m for m in needs.media if m.bounded), None)
    if medium is None:
        return
    moved = _emitter_placements(needs)
    collides = is_scattering_visible(needs, settings) or any(m.emits for m in needs.media)
    parts = [(facts.name, part) for facts, view in zip(needs.media, needs.views, strict=True) for part in view.parts]
    bounded = [(name, part) for name, part in parts if not part.exact_line]
    rgb = [name for name, part in bounded if part.channels == 3] if collides and not settings.deterministic else []
    field, grey = f"the bounded field of {', '.join(rgb)} is rgb", "make it grey (a plugin's channel_count(): 1)"
    reasons = [
        # Their light is summed along a flight, which knows the densities of channels at its end only.
        (bool(rgb) and any(v.shows_gaussians for v in needs.views), f"a medium of Gaussians shines, and {field}", grey),
        (
            bool(moved) and any(part.field.may_jump for _, part in bounded),
            f"the derivative of {', '.join(moved)} was requested, which misses jumps of its values",
            "use finite differences",
        ),
    ]
    kind = f"is a {medium.bounded}, which is known at points only"
    _raise_first(f"the medium in {medium.name} {kind}", reasons, "sample it to a mivol_voxels")


def check_gaussians(needs: Needs, aovs: tuple[str, ...]) -> None:
    """Refuse requests for the cells of a grid in a medium of Gaussians or of an octree."""
    medium = next((m for m in needs.media if m.has_own_walk), None)
    if medium is None:
        return
    moved = _emitter_placements(needs)
    reasons = [
        ("depth" in aovs, "aovs asks for depth", "ask for tau and alpha only"),
        (bool(moved), f"the derivative of {', '.join(moved)} was requested", "use finite differences"),
    ]
    if medium.leaves:
        _raise_first(f"the medium in {medium.name} is an octree", reasons, "give its values as a mivol_voxels")
    kind = f"is made of {medium.gaussians} Gaussians that rays are traced through"
    _raise_first(f"the medium in {medium.name} {kind}", reasons, "convert them to a grid (mivol convert)")


def check_nested(needs: Needs) -> None:
    """Refuse derivatives with respect to the placement of emitters beside a nested field: the terms at the faces of its levels
    are unknown.
    """
    moved = _emitter_placements(needs)
    level = next((b.name for b in needs.boundaries if b.hole is not None), None)
    if moved and level is not None:
        raise MivolError(
            f"the derivative of {', '.join(moved)} was requested and {level} belongs to a nested field, at whose inner faces "
            "no shadow ray is followed as it turns: use finite differences."
        )


def _raise_first(medium: str, reasons: list[tuple[bool, str, str]], other_way: str) -> None:
    """Raise for the first reason (condition, finding, way out) whose condition holds."""
    for holds, finding, way_out in reasons:
        if holds:
            raise MivolError(f"{medium}, and {finding}: {way_out}, or {other_way}.")


def _emitter_placements(needs: Needs) -> list[str]:
    """The keys of parameters with gradients that place an emitter."""
    return [k for k in needs.parameters if k.endswith((".position", ".to_world"))]
