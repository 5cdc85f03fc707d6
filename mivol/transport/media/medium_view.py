r"""Mitsuba's media as sums of fields, each in its place, the same for the plugins of mivol and of Mitsuba.

.. math:: \sigma_t(x) = s \sum_k f_k(x)

with a scale s and parts f_k that are a grid or a constant (``sigma_t`` alone, or ``sigma_a`` and ``sigma_s``). Optical depth is
linear in each part and is integrated part by part (:mod:`mivol.transport.media.extinction`). A homogeneous medium therefore
stores no grid, and two grids need not share a resolution.

Conventions. A grid is vacuum outside its own box. A constant fills the boundary of its medium, except under a stock
``heterogeneous``, which clips a constant to the box of its ``constvolume``. Values are read from the arrays of ``mi.traverse``,
with their gradients.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.gaussian_field import GaussianField
from mivol.fields.plugin_field import PluginField
from mivol.fields.protocol import BOUNDED, Field
from mivol.fields.spherical_grid import SphericalGrid
from mivol.kernel_recording import is_recording
from mivol.scene_graph import find_children, list_values, traverse, traverse_children
from mivol.transport.media.extinction import BoundedExtinction, ConstantExtinction, Extinction
from mivol.transport.media.gaussian_extinction import GaussianExtinction
from mivol.transport.media.grid_extinction import ActivatedGridExtinction, GridExtinction
from mivol.transport.media.octree_extinction import LeafField, OctreeExtinction
from mivol.transport.media.phases import HenyeyGreenstein, Isotropic, Microflakes, Phase, PluginPhase, read_phase
from mivol.transport.media.stock_grids import StockGrids, holds_values
from mivol.transport.traversal.box import Box, opaque_numbers
from mivol.transport.traversal.lattice import Lattice

__all__ = ["ASYMMETRY", "MediumView", "nested_field", "view_medium"]


@dataclass
class MediumView:
    """The extinction of a medium, as transport sees it.

    Attributes:
        medium: the Mitsuba object.
        parts: fields; their sum, times ``scale``, is sigma_t.
        scale: dimensionless factor, differentiable if the plugin makes it so.
        albedo_arrays: the arrays of the albedo, or of the ``sigma_s`` part.
        albedo: the albedo, a volume or a constant; None if ``sigma_s`` is a part.
        microflakes: the matrix S (xx, yy, zz, xy, xz, yz) of an ``sggx`` phase function, with derivatives; else None.
            The extinction then depends on the direction: sigma_t sqrt(w^T S w) (Heitz et al. 2015, Eq. 6).
        emission: Le [radiance], a volume or a constant; its source function is (1 - albedo) Le. None without emission.
        emission_density: emitted light [radiance/length], independent of the extinction; None without it.
        emission_lattice: the grid of ``emission_density``, ``emission`` or ``albedo``, whose cells are walked if the
            extinction has no grid. Its values are zeros.
        emission_arrays: the arrays of ``emission`` and ``emission_density``.
        numbers: the constants among ``scale``, the coefficients of the extinction and the ``g`` of a stock ``hg``, as in
            ``mi.traverse``.
        stock_boxes: the boxes of stock grids of emission and albedo, by the pointer of the volume. Mitsuba repeats the border
            of a stock grid outside the box, where mivol has no emission.
        phase: the phase function.
    """

    medium: mi.Medium
    parts: list[Extinction]
    scale: mi.Float
    albedo_arrays: list = field(default_factory=list)
    albedo: mi.Volume | mi.Float | mi.Color3f | None = None
    microflakes: list[mi.Float] | None = None
    emission: mi.Volume | mi.Float | mi.Color3f | None = None
    emission_density: mi.Volume | mi.Float | mi.Color3f | None = None
    emission_lattice: Lattice | None = None
    emission_arrays: list = field(default_factory=list)
    stock_boxes: dict[int, Box] = field(default_factory=dict)
    numbers: dict[str, float | mi.Float | mi.Color3f] = field(default_factory=dict)
    phase: Phase = field(default_factory=Isotropic)

    def holds(self, volume: mi.Volume, p: mi.Point3f) -> mi.Bool:
        """Whether a point lies in the box of a stock volume of emission; true for volumes of mivol, which are 0 outside."""
        if volume.ptr not in self.stock_boxes:
            return mi.Bool(True)
        rows = self.stock_boxes[volume.ptr].rows()
        local = [x * p.x + y * p.y + z * p.z + shift for x, y, z, shift in rows]
        return (local[0] >= 0) & (local[0] <= 1) & (local[1] >= 0) & (local[1] <= 1) & (local[2] >= 0) & (local[2] <= 1)

    @property
    def emits(self) -> bool:
        """Whether the medium is a source of light."""
        return self.emission is not None or self.emission_density is not None or self.shows_gaussians

    @property
    def gaussians(self) -> GaussianExtinction | None:
        """The Gaussians of the medium, which are then its only part; None without Gaussians."""
        return next((part for part in self.parts if isinstance(part, GaussianExtinction)), None)

    @property
    def shows_gaussians(self) -> bool:
        """Whether the medium shows the colours of its Gaussians: light in an order along a ray, and no function of a point."""
        return self.gaussians is not None and self.gaussians.shows

    @property
    def channels(self) -> int:
        """1 if every part is grey, 3 if some part is rgb."""
        return max(part.channels for part in self.parts)

    def by_quadrature(self) -> MediumView:
        """The same medium, whose bounded parts are integrated by quadrature."""
        return replace(self, parts=[p.by_quadrature() if isinstance(p, BoundedExtinction) else p for p in self.parts])

    @property
    def walked_lattice(self) -> Lattice | None:
        """The grid whose cells a sweep follows; None without a grid."""
        return next((p.lattice for p in self.parts if p.lattice is not None), self.emission_lattice)


STOCK = ("HomogeneousMedium", "HeterogeneousMedium")

ASYMMETRY = "phase_function.g"
"""Name of the ``g`` of a medium with Mitsuba's ``hg``, as in ``mi.traverse``."""


def view_medium(
    medium: mi.Medium,
    boundary: Box | None = None,
    grids: StockGrids | None = None,
    level: int = 0,
    phase: Phase | None = None,
    scale: float | None = None,
) -> MediumView:
    """View a medium as a sum of fields.

    Args:
        medium: ``mivol_medium``, ``homogeneous`` or ``heterogeneous``, over volumes of Mitsuba, of mivol or of another package.
        boundary: the boundary, if the boundary is a box. Mitsuba prints the place of a stock grid to 6 digits only; a grid
            filling its boundary to these digits is put exactly there.
        grids: what is known of the stock grids, to read and to extend; by default nothing.
        level: level of a nested radiance field.
        phase: the phase function, if it was read before.
        scale: the scale, if it is a number and was read before.

    Raises:
        MivolError: a medium or a volume of another kind.
    """
    kind = medium_kind(medium)
    params = traverse_children(medium)
    if kind not in (*STOCK, "mivol_medium"):
        raise MivolError(f"a medium of type {kind} was found; mivol_medium, homogeneous or heterogeneous is expected.")
    children = find_children(medium)
    values = list_values(params)
    names = [n for n in ("sigma_t", "sigma_a", "sigma_s") if n in children]
    grids = StockGrids() if grids is None else grids
    if scale is None:
        scale = params["scale"] if "scale" in params.properties else 1.0
    scale = _read_scale(scale)
    parts = [_part(name, params, children[name], kind, scale, boundary, grids) for name in names]
    of_albedo = "sigma_s." if "sigma_s" in names else "albedo."
    own = {k: v for k, v in values if k.startswith(of_albedo)}
    # Of a grid, its values alone: not what they are made of (weights, a table), nor the numbers of bricks.
    albedo_arrays = [own[of_albedo + "data"]] if of_albedo + "data" in own else list(own.values())
    albedo = _field(params, "albedo") if "sigma_s" not in names else None
    emission, emission_density = _field(params, "emission"), _field(params, "emission_density")
    emission_arrays = [v for k, v in values if k.startswith("emission") and k.endswith((".data", ".value.value"))]
    if not parts:
        parts, albedo, emission_arrays = [_part_of_field(emission, level)], mi.Float(0), []
        if isinstance(parts[0], GaussianExtinction):
            emission = None  # their light is in their order along a ray: no function of place has it
    light = []
    if emission is not None or emission_density is not None:
        light = [emission_density, emission, albedo]
        for name, volume in zip(("emission_density", "emission", "albedo"), light, strict=True):
            _check_cells(name, params, volume, boundary, grids)
    emission_lattice = _emission_lattice(emission_density, light, boundary, grids)
    stock_boxes = {v.ptr: Box(grids.place(v, boundary)) for v in light if _repeats_border(v)}
    numbers = {k.partition(".")[0]: v for k, v in values if k in ("scale", *(f"{n}.value.value" for n in names))}
    if phase is None:
        phase = read_phase(medium.phase_function())
        _check_microflakes(phase)
    if isinstance(phase, HenyeyGreenstein):
        numbers[ASYMMETRY] = params[ASYMMETRY]
    return MediumView(
        medium,
        parts,
        scale,
        albedo_arrays,
        albedo,
        phase.entries if isinstance(phase, Microflakes) else None,
        emission,
        emission_density,
        emission_lattice,
        emission_arrays,
        stock_boxes,
        numbers,
        phase,
    )


def _read_scale(scale: float | mi.Float) -> mi.Float:
    """A scale as an array. A literal other than 1 would make a new kernel for each number of a stock medium."""
    is_number = isinstance(scale, float) and scale != 1
    return mi.Float(opaque_numbers(np.array([scale]))[0]) if is_number else mi.Float(scale)


def _check_microflakes(phase: Phase) -> None:
    """Refuse an ``sggx`` whose matrix varies in space.

    In a blend or a mixture Mitsuba lets microflakes scatter light, but leaves the extinction independent of the direction.

    Raises:
        MivolError: a matrix that varies.
    """
    if isinstance(phase, PluginPhase) and phase.plugin.class_name() == "SGGXPhaseFunction":
        matrices = dr.ravel(next(v for k, v in list_values(traverse(phase.plugin)) if k.startswith("S.")))
        raise MivolError(
            f"the sggx phase function of a medium varies over its {dr.width(matrices) // 6} voxels; an extinction that "
            "depends on the direction is exact for one S everywhere: give S as a gridvolume of one voxel."
        )


def _field(params: mi.SceneParameters, name: str) -> mi.Volume | mi.Float | mi.Color3f | None:
    """The coefficient of a medium under a name: a constant with its gradient, or a volume; None without the coefficient."""
    if f"{name}.value.value" in params.properties:
        return params[f"{name}.value.value"]
    key = next((k for k in params.properties if k.startswith(name + ".")), None)
    return None if key is None else params.properties[key][2]


def _part_of_field(volume: mi.Volume, level: int) -> ActivatedGridExtinction | GaussianExtinction:
    """The extinction of a medium made of a radiance field: Gaussians, or the activation of a level of ``mivol_sh``."""
    if hasattr(volume, "mivol_extinction"):
        return _field_part("emission", volume.mivol_extinction, mi.Float(1), shows=True)
    lattice = Lattice(volume.mivol_densities[level], volume.mivol_field.level_to_world(level))
    return ActivatedGridExtinction("sigma_t", lattice, volume.mivol_field.activation_function)


def _emission_lattice(emission_density: object, others: list, boundary: Box | None, grids: StockGrids) -> Lattice | None:
    """The grid of the emission density, or the finest grid of the other fields, as a lattice of zeros; None without a grid."""
    finest = max((v for v in others if _is_grid(v)), key=lambda v: int(np.prod(v.resolution())), default=None)
    lead = emission_density if _is_grid(emission_density) else finest
    if lead is None:
        return None
    x, y, z = (int(n) for n in lead.resolution())
    return Lattice(dr.zeros(mi.TensorXf, (z, y, x, 1)), grids.place(lead, boundary))


def _check_cells(name: str, params: mi.SceneParameters, volume: object, boundary: Box | None, grids: StockGrids) -> None:
    """Refuse a volume that the emission of a medium cannot be summed with: its values are not trilinear in the cells of a grid.

    Raises:
        MivolError: a volume of another package, or a stock grid with another filter or with borders that are not clamped.
    """
    if not _repeats_border(volume):
        return
    found = f"a volume {type(volume).__name__}"
    if volume.class_name() == "GridVolume":
        if grids.is_trilinear(volume, Lattice(_tensor(params[f"{name}.data"]), grids.place(volume, boundary))):
            return
        found = "a gridvolume with another filter_type than trilinear or another wrap_mode than clamp"
    raise MivolError(f"the {name} of a medium that emits is {found}; expected a trilinear grid: sample it to a mivol_voxels.")


def _is_grid(volume: object) -> bool:
    return isinstance(volume, mi.Volume) and volume.class_name() != "ConstVolume"


def _repeats_border(volume: object) -> bool:
    """Whether a volume repeats its border outside its own box, as stock grids do."""
    return _is_grid(volume) and not hasattr(volume, "mivol_to_world")


def medium_kind(medium: mi.Medium) -> str:
    """Class name of a medium; ``mivol_medium`` for media of mivol (Mitsuba names every Python class after its base)."""
    return "mivol_medium" if hasattr(medium, "coefficients") else medium.class_name()


def nested_field(medium: mi.Medium) -> SphericalGrid | None:
    """The radiance field of a medium, if the field has more than one level; otherwise None."""
    field = getattr(find_children(medium).get("emission"), "mivol_field", None)
    return field if field is not None and field.levels > 1 else None


def _field_part(
    name: str, field: Field | GaussianField | LeafField, scale: mi.Float, shows: bool = False
) -> BoundedExtinction | GaussianExtinction | OctreeExtinction:
    """The part of an extinction for a field from a plugin of mivol.

    Raises:
        MivolError: a field of another kind; a majorant that is negative or not finite; or a recording, in which no majorant
            can be read and no Gaussians can be listed.
    """
    if isinstance(field, LeafField):
        return OctreeExtinction(name, field)
    has_lists = isinstance(field, GaussianField)
    if field.line != BOUNDED and not has_lists:
        raise MivolError(
            f"{name} is a {type(field).__name__} that declares {field.line!r}; media read {BOUNDED!r} fields, Gaussians and "
            "octrees."
        )
    if is_recording():
        reason = "whose cells cannot be listed" if has_lists else "whose majorant cannot be read"
        raise MivolError(f"{name} is a {type(field).__name__}, {reason} while dr.freeze records: render without dr.freeze.")
    if has_lists:
        return GaussianExtinction("sigma_t" if shows else name, field, dr.detach(scale), shows)
    majorant = max(field.bound())
    if not 0 <= majorant < np.inf:
        kind = type(field).__name__
        raise MivolError(f"the majorant of {name}, a {kind}, is {majorant:.4g}; a finite number of at least 0 is expected.")
    return BoundedExtinction(name, field, dr.detach(scale), dr.opaque(mi.Float, majorant))


def _part(
    name: str,
    params: mi.SceneParameters,
    volume: mi.Volume,
    kind: str,
    scale: mi.Float,
    boundary: Box | None,
    grids: StockGrids,
) -> Extinction:
    """The part of an extinction under ``name`` among the parameters of a medium.

    Volumes of Mitsuba and of mivol with trilinear values are walked cell by cell. Others are called at points.
    """
    if hasattr(volume, "mivol_extinction"):
        return _field_part(name, volume.mivol_extinction, scale)
    is_stock = volume.class_name() == "GridVolume"
    if not holds_values(volume):
        return _field_part(name, PluginField(volume), scale)
    grid, constant = f"{name}.data", f"{name}.value.value"
    if grid in params.properties:
        bricks = getattr(volume, "mivol_bricks", None)
        lattice = Lattice(_tensor(params[grid]), grids.place(volume, boundary), bricks=bricks)
        if bricks is not None:
            lattice = lattice.where_derivatives()
        if is_stock and not grids.is_trilinear(volume, lattice):
            return _field_part(name, PluginField(volume), scale)
        return GridExtinction(name, lattice)
    value = params[constant]
    if kind != "HeterogeneousMedium":  # a stock heterogeneous fills the box of its constvolume only
        return ConstantExtinction(name, value)
    channels = [value[c] for c in range(dr.size_v(value))] if dr.size_v(value) == 3 else [mi.Float(value)]
    values = mi.TensorXf(dr.ravel(mi.Color3f(*channels)) if len(channels) == 3 else channels[0], (1, 1, 1, len(channels)))
    return GridExtinction(name, Lattice(values, grids.place(volume, None)))


def _tensor(values: mi.TensorXf) -> mi.TensorXf:
    """Grid values as (Z, Y, X, C), or (bricks, 8, 8, 8, C)."""
    if values.array.state == dr.VarState.Literal:
        # Look-ups in an empty grid of one literal would leave the state of a loop unchanged, and Dr.Jit 1.5 then raises.
        dr.make_opaque(values)
    return values if len(values.shape) >= 4 else mi.TensorXf(values.array, (*values.shape, 1))
