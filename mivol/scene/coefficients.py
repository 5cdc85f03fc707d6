r"""The coefficients of a medium: extinction and albedo, or absorption and scattering.

.. math:: \sigma_t = \sigma_a + \sigma_s, \qquad \alpha = \sigma_s / \sigma_t, \qquad \sigma_n = \bar\sigma - \sigma_t

Conventions. Coefficients are per world length. Numbers and rgb triples become constant volumes, so all coefficients have the
same interface. A constant fills the whole boundary of the medium.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.gaussian_field import GaussianField
from mivol.fields.protocol import BOUNDED, Field
from mivol.scene_graph import traverse
from mivol.transport.media.medium_view import ASYMMETRY
from mivol.transport.media.octree_extinction import LeafField
from mivol.transport.traversal.box import clip_to_box

COEFFICIENT_PAIRS = (("sigma_t", "albedo"), ("sigma_a", "sigma_s"))

OPAQUE_EXTINCTION = 1e10
"""Extinction [1/length] at which no ray of Mitsuba's integrators misses a medium."""


class Coefficients:
    """The volumes behind the coefficients of a medium.

    Args:
        volumes: ``sigma_t`` and ``albedo``, or ``sigma_a`` and ``sigma_s``.
        lights: ``emission`` and ``emission_density``, if given.
    """

    def __init__(self, volumes: dict[str, mi.Volume], lights: dict[str, mi.Volume]) -> None:
        self.volumes, self.lights, self.has_warned = volumes, lights, False

    @classmethod
    def from_props(cls, props: mi.Properties) -> Coefficients:
        """Read the coefficients of a medium from plugin parameters.

        Raises:
            MivolError: both pairs, half of a pair, a negative number, or a radiance field in another place than the emission.
        """
        if "velocity" in props:
            raise MivolError("mivol_medium was given a velocity; motion blur is not there yet: leave it out for a still frame.")
        given = [n for pair in COEFFICIENT_PAIRS for n in pair if n in props]
        if is_radiance_field(props.get("emission", 0.0)) or isinstance(_find_field(props, "emission"), GaussianField):
            return cls._of_field(props, given)
        fields = [n for n in (*given, "emission_density") if is_radiance_field(props.get(n, 0.0))]
        if fields:
            raise MivolError(f"mivol_medium was given a mivol_sh as {fields[0]}; give it as the emission, and nothing else.")
        elsewhere = [
            n for n in (*given, "emission_density") if n != "sigma_t" and isinstance(_find_field(props, n), GaussianField)
        ]
        if elsewhere:
            raise MivolError(
                f"mivol_medium was given a mivol_gaussians as {elsewhere[0]}; give it as sigma_t, with an albedo, to be lit, "
                "or as the emission, and nothing else, to show its colours."
            )
        lights = [n for n in ("emission", "emission_density") if n in props]
        _refuse_points(props, ["albedo", *lights])
        if lights and isinstance(_find_field(props, "sigma_t"), GaussianField):
            raise MivolError(
                f"mivol_medium was given {' and '.join(lights)} beside a sigma_t of mivol_gaussians; give the Gaussians as the "
                "emission, and nothing else, to show their own colours."
            )
        octrees = [n for n in (*given, *lights) if isinstance(_find_field(props, n), LeafField)]
        if lights and octrees:
            raise MivolError(
                f"mivol_medium was given {' and '.join(lights)} and a mivol_octree as {octrees[0]}; a medium that emits needs "
                "the cells of a grid: give the values as a mivol_voxels."
            )
        shaded = [n for n in given if _is_shaded(props, n)]
        if shaded:
            raise MivolError(
                f"mivol_medium was given a shaded mivol_transfer as {shaded[0]}; shade what it emits (emission) alone."
            )
        pair = next((p for p in COEFFICIENT_PAIRS if set(given) <= set(p)), None)
        if pair is None or not given or given == ["albedo"]:
            raise MivolError(
                f"mivol_medium was given {' and '.join(given) or 'no coefficient'}; give sigma_t (with albedo, if it scatters) "
                "or sigma_a and sigma_s."
            )
        return cls(
            {name: _to_volume(props, name) for name in pair},
            {name: _to_volume(props, name) for name in ("emission", "emission_density") if name in props},
        )

    @classmethod
    def _of_field(cls, props: mi.Properties, given: list[str]) -> Coefficients:
        """Make a medium from a radiance field, which brings its own extinction."""
        extra, field = [*given, *(n for n in ("scale", "emission_density") if n in props)], props["emission"]
        kind = "mivol_sh" if is_radiance_field(field) else "mivol_gaussians"
        if extra:
            raise MivolError(
                f"mivol_medium was given {' and '.join(extra)} beside a {kind} as its emission, which brings its own "
                f"extinction; take {'it' if len(extra) == 1 else 'them'} out."
            )
        if kind == "mivol_gaussians" and not field.mivol_extinction.has_colours:
            raise MivolError("mivol_medium was given Gaussians without colours as its emission; give them harmonics.")
        return cls({}, {"emission": field})

    @property
    def is_field(self) -> bool:
        """Whether the medium is a radiance field."""
        return not self.volumes

    @property
    def extinction(self) -> list[mi.Volume]:
        """The volumes that sum to the extinction."""
        return [v for n, v in self.volumes.items() if n != "albedo"]

    def check_constants(self) -> None:
        """Refuse invalid constants after an update. Not while ``dr.freeze`` records: values cannot be read then.

        Raises:
            MivolError: NaN, infinite or negative constants, or an albedo above 1.
        """
        for name, volume in {**self.volumes, **self.lights}.items():
            if _is_constant(volume):
                check_constant(_constant_value(volume), name, " of a mivol_medium")

    @property
    def is_homogeneous(self) -> bool:
        """Whether all coefficients are constants."""
        return all(_is_constant(v) for v in self.volumes.values())

    @property
    def is_rgb(self) -> bool:
        """Whether the extinction differs between channels."""
        return any(_channel_count(v) == 3 for v in self.extinction)

    def bound(self) -> mi.Spectrum:
        """Largest extinction over space, without the medium's scale.

        For constants the bound is per channel, because Mitsuba samples a homogeneous medium by its majorant alone. For grids
        all channels share a bound, as in stock ``heterogeneous``. A medium that emits stops every ray, see :meth:`eval`.
        """
        if self.lights:
            return mi.Spectrum(dr.opaque(mi.Float, OPAQUE_EXTINCTION))
        if self.is_homogeneous:
            return sum((mi.Spectrum(dr.detach(_constant_value(v))) for v in self.extinction), mi.Spectrum(0))
        bound = mi.Float(sum(_maximum(v) for v in self.extinction))
        dr.make_opaque(bound)
        return mi.Spectrum(bound)

    def reach(self, ray: mi.Ray3f) -> tuple[mi.Bool, mi.Float, mi.Float]:
        """Whether and where a ray can meet extinction: in the boxes of the grids, or anywhere with a constant part."""
        if self.lights or any(_is_constant(v) for v in self.extinction):
            return mi.Bool(True), mi.Float(0), mi.Float(dr.inf)
        boxes = [volume.bbox() for volume in self.extinction]
        low = np.min([np.array(b.min) for b in boxes], axis=0).tolist()
        high = np.max([np.array(b.max) for b in boxes], axis=0).tolist()
        # Mitsuba's own box class belongs to the first variant of a process, and refuses rays of a second variant.
        axes = np.eye(3, 4).tolist()
        _, _, t0, t1 = clip_to_box(axes, low, high, ray.o, ray.d, mi.Float64(0), mi.Float64(ray.maxt))
        return t1 > t0, mi.Float(t0), mi.Float(t1)

    def eval(
        self, mei: mi.MediumInteraction3f, scale: mi.Float, majorant: mi.Spectrum, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Spectrum, mi.Spectrum]:
        """Scattering, null and total coefficients at a point, as returned by Mitsuba's media.

        NaN for a medium that emits: Mitsuba's integrators ignore the light, and an image without it would look right. An error
        is not raised, because Mitsuba also compiles media of other living scenes.
        """
        if self.lights:
            self._warn()
            return (mi.Spectrum(dr.nan),) * 3
        first, second = (_eval(v, mei, active) for v in self.volumes.values())
        sigma_t, sigma_s = (first, first * second) if "sigma_t" in self.volumes else (first + second, second)
        # Majorant and sum are rounded differently: without the clamp a null coefficient could be a negative probability.
        sigma_n = dr.maximum(scale * (majorant - sigma_t), 0)
        return scale * sigma_s, sigma_n, scale * sigma_t

    def _warn(self) -> None:
        """Warn once of the light that a Mitsuba integrator would leave out."""
        if not self.has_warned:
            mi.Log(
                mi.LogLevel.Warn,
                f"an integrator of Mitsuba's met a mivol_medium with {' and '.join(self.lights)}, whose light it would leave "
                "out: its pixels are NaN there; render such a scene with the integrator mivol.",
            )
        self.has_warned = True

    def __repr__(self) -> str:
        fields = {**self.volumes, **self.lights}
        return "mivol_medium[" + ", ".join(f"{n}={v.class_name()}" for n, v in fields.items()) + "]"


def is_radiance_field(value: object) -> bool:
    """Whether a volume is a field of density and colour."""
    return hasattr(value, "mivol_field")


def _refuse_points(props: mi.Properties, names: list[str]) -> None:
    """Refuse a field without cells under one of the names.

    Raises:
        MivolError: a bounded field.
    """
    for name in names:
        field = _find_field(props, name)
        if getattr(field, "line", None) == BOUNDED:
            raise MivolError(
                f"mivol_medium was given a {type(field).__name__}, whose values are known at points only, as {name}; a number, "
                "an rgb triple or a grid is expected: make the field a grid (nodes of a mivol_hash)."
            )


def _find_field(props: mi.Properties, name: str) -> Field | GaussianField | LeafField | None:
    """The field behind a volume of mivol; None for another volume, a number, or nothing."""
    return getattr(props.get(name, 0.0), "mivol_extinction", None)


def _is_shaded(props: mi.Properties, name: str) -> bool:
    """Whether a volume is lit; light is not a coefficient."""
    transfer = getattr(props.get(name, 0.0), "mivol_transfer", None)
    return transfer is not None and transfer.effects.shading is not None


def _to_volume(props: mi.Properties, name: str) -> mi.Volume:
    """Convert a coefficient to a volume: a number, an rgb triple (of any size) or a volume."""
    value = props.get(name, 0.0)
    if isinstance(value, mi.Volume):
        return value
    if isinstance(value, mi.Texture):
        return mi.load_dict({"type": "constvolume", "value": value})
    if isinstance(value, (int, float)):
        check_coefficient(float(value), name)
        return mi.load_dict({"type": "constvolume", "value": float(value)})
    if isinstance(value, (str, mi.Object)):
        found = repr(value) if isinstance(value, str) else f"a {value.class_name()}"
        raise MivolError(f"{name} is {found}; a number, an rgb triple or a volume is expected.")
    rgb = [float(v) for v in np.array(value).ravel()]
    for v in rgb:
        check_coefficient(v, name)
    return mi.load_dict({"type": "constvolume", "value": {"type": "rgb", "value": rgb}})


def check_coefficient(value: float, name: str, owner: str = "") -> None:
    """Refuse a number that is not a valid coefficient.

    Args:
        value: the number.
        name: ``sigma_t``, ``albedo``, ``scale`` and so on.
        owner: the owner of the coefficient, if an optimizer may have moved the number: `` of the medium in smoke``.

    Raises:
        MivolError: a NaN, infinite or negative number, an albedo above 1, or a mean cosine outside (-1, 1).
    """
    way_out = ": clip it after each step" if owner else ""
    if name == ASYMMETRY:
        if not -1 < value < 1:
            raise MivolError(f"{name}{owner} is {value:.9g}; a mean cosine between -1 and 1 is expected{way_out}.")
        return
    if not np.isfinite(value) or value < 0:
        raise MivolError(f"{name}{owner} is {value:.9g}; a finite number of at least 0 is expected{way_out}.")
    if name == "albedo" and value > 1:
        raise MivolError(f"albedo{owner} is {value:.9g}; the share of light that is scattered lies in [0, 1]{way_out}.")


def check_constant(value: float | mi.Float | mi.Color3f, name: str, owner: str) -> None:
    """Refuse an invalid constant, grey or rgb. Reads the constant: not while ``dr.freeze`` records.

    Raises:
        MivolError: as :func:`check_coefficient`.
    """
    for number in np.array(dr.detach(value), dtype=np.float64).ravel():
        check_coefficient(float(number), name, owner)


def _is_constant(volume: mi.Volume) -> bool:
    return volume.class_name() == "ConstVolume"


def _constant_value(volume: mi.Volume) -> mi.Float | mi.Color3f:
    return traverse(volume)["value.value"]


def _channel_count(volume: mi.Volume) -> int:
    return dr.size_v(_constant_value(volume)) if _is_constant(volume) else volume.channel_count()


def _maximum(volume: mi.Volume) -> float:
    return float(np.max(np.array(dr.detach(_constant_value(volume))))) if _is_constant(volume) else volume.max()


def _eval(volume: mi.Volume, it: mi.Interaction3f, active: mi.Bool) -> mi.Spectrum:
    if _channel_count(volume) == 3:
        return volume.eval(it, active)
    return mi.Spectrum(volume.eval_1(it, active))
