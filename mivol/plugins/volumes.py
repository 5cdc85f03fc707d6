"""Volumes: "mivol_voxels", a dense grid; "mivol_transfer", a grid seen through a table; "mivol_sh", a radiance field;
"mivol_gaussians", Gaussians for ray tracing; "mivol_hash" and "mivol_network", extinctions of networks; "mivol_octree", leaves.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.blackbody import read_hot_matter
from mivol.fields.bricks import Bricks
from mivol.fields.field_files import field_from_props, read_field
from mivol.fields.gaussian_field import GaussianField
from mivol.fields.hash_density import FittedDensity, HashDensity, TabulatedDensity
from mivol.fields.protocol import Field
from mivol.fields.sampled_field import SampledField
from mivol.fields.spherical_grid import SphericalGrid
from mivol.fields.transfer import Transfer
from mivol.fields.voxels import SparseVoxels, Voxels, read_voxels
from mivol.transport.media.octree_extinction import LeafField
from mivol.transport.traversal.grid_blocks import find_stored_distances


class VoxelVolume(mi.Volume):
    """``<volume type="mivol_voxels">``: a trilinear grid, 1 or 3 channels.

    Parameters:
        filename, grid or data: a file (.vol, .vdb, .nvdb, .npy, .npz, .nrrd, .mhd, .nii, ...), a ``mi.VolumeGrid`` or a tensor.
            For a file of several arrays, ``grid`` is the name of one of them.
        to_world: places the unit cube.
        use_grid_bbox: place the grid by its file's own box first. Default false.
        signed: permit negative values, as for a ``g``. Default false.
        scale: factor on the values of a file or grid, a number or three (``"1, 0.5, 0.2"``), which make three channels of one.
            Default 1.
        storage: dense, sparse (bricks of 8^3 voxels; elsewhere 0) or auto: sparse for a file or grid of at least 128 MiB of
            which at most half would be stored. Default auto.
        bricks, resolution, offset: for sparse ``data`` (bricks, 8, 8, 8, C): ascending numbers (z, y, x) of the bricks among
            those of the box, voxels of the box ``x, y, z``, and voxels of the first brick before the box (default 0, 0, 0).

    The parameter ``data`` holds the values: (Z, Y, X, C), or of the stored bricks (bricks, 8, 8, 8, C), with their numbers as
    ``bricks``.
    """

    def __init__(self, props: mi.Properties) -> None:
        self.field = self.read(props)
        self.texture = self.field.freezable_texture
        self.hold_bricks()
        props["to_world"] = mi.ScalarTransform4f(self.field.to_world)
        super().__init__(props)

    def read(self, props: mi.Properties) -> Voxels | SparseVoxels:
        """Make the grid from the parameters."""
        return read_voxels(props)

    def hold_bricks(self) -> None:
        """Hold the arrays of a sparse grid: ``dr.freeze`` finds arrays only among a plugin's own attributes."""
        bricks = self.field.bricks
        if bricks is None:
            return
        if bricks.distances is None:
            bricks.distances = find_stored_distances(bricks)
        self.data, self.bricks = self.field.tensor, self.field.stored
        self.table, self.distances, self.stored = bricks.table, bricks.distances, bricks.stored

    @property
    def mivol_bricks(self) -> Bricks | None:
        """Where the values of a sparse grid are stored; None for a dense grid."""
        return self.field.bricks

    @property
    def mivol_to_world(self) -> np.ndarray:
        return self.field.to_world

    def eval(self, it: mi.Interaction3f, active: mi.Bool = True) -> mi.Spectrum:
        return mi.Spectrum(*self.field.eval_colour(it.p, active))

    def eval_1(self, it: mi.Interaction3f, active: mi.Bool = True) -> mi.Float:
        return self.field.eval_colour(it.p, active)[0]

    def eval_3(self, it: mi.Interaction3f, active: mi.Bool = True) -> mi.Vector3f:
        return mi.Vector3f(*self.field.eval(it.p, None, active))

    def eval_n(self, it: mi.Interaction3f, active: mi.Bool = True) -> list[mi.Float]:
        return self.field.eval(it.p, None, active)

    def max(self) -> float:
        return max(self.field.bound())

    def max_per_channel(self) -> list[float]:
        return self.field.bound()

    def resolution(self) -> mi.ScalarVector3i:
        return mi.ScalarVector3i(self.field.res[::-1])

    def channel_count(self) -> int:
        return self.field.channels

    def traverse(self, callback: mi.TraversalCallback) -> None:
        for name, value in self.field.parameters().items():
            callback.put(name, value, mi.ParamFlags.Differentiable)
        if self.field.bricks is not None:
            callback.put("bricks", self.bricks, mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        self.field.refresh()
        self.hold_bricks()

    def to_string(self) -> str:
        return repr(self.field)


class BlackbodyVolume(VoxelVolume):
    """``<volume type="mivol_blackbody">``: the light of hot matter, an ``emission`` from a grid of temperatures.

    Parameters:
        filename, grid or data, to_world, use_grid_bbox, storage: the grid of one channel, as of ``mivol_voxels``.
        kelvin: temperature per unit of the grid [K]. Default 1.
        offset: value of the grid at 0 K; values below count as 0 K. Default 0.
        normalize: colour alone: each spectrum is divided by its peak, as in pbrt-v4. Otherwise the radiance is that of a
            black body, in W m^-2 sr^-1 weighted by the CIE functions. Default false.
        scale: factor on the radiance, a number or three. Default 1.

    Temperatures become colours voxel by voxel, and colours are interpolated. The parameter ``data`` holds the colours
    (Z, Y, X, 3); temperatures have no derivative (a ``mivol_transfer`` with a table of colours has).
    """

    def read(self, props: mi.Properties) -> Voxels | SparseVoxels:
        return read_voxels(props, read_hot_matter(props).emit)


class SphericalVolume(mi.Volume):
    """``<volume type="mivol_sh">``: density, and colour that depends on the direction, as a medium's ``emission``.

    Parameters:
        filename: a field written by ``mivol`` or svox2 (.npz), or
        filename, nodes: a hash grid or a NeRF, whose density and colours are taken at the nodes of a grid with this number
            along the longest edge (default 128); an octree becomes a grid with a node in each smallest cell, or
        density, sh: tensors (Z, Y, X, 1) and (Z, Y, X, basis, 3), 1 to 25 harmonics in the order of ``dr.sh_eval``.
        to_world: places the unit cube; moves a field of a file from the place given in the file. Densities are per world
            length: a field scaled by n is n times as opaque, unless its densities are divided by n.
        activation: none, relu, softplus or exp, of the interpolated density. Default relu, or the file's.
        offset: added to colours. Default 0.5, or the file's.
        clamp: show colours below 0 as 0. Default true, or the file's.
        space: space of the colours: linear (radiance) or srgb (code values, as in fits of photographs), shown as the
            corresponding radiance. Default linear, or the file's.

    ``density`` and ``sh`` are its parameters; a sparse field has them as (nodes, 1) and (nodes, basis, 3). A nested field
    fills the box of its outermost level; the medium's shape must be a cube.
    """

    def __init__(self, props: mi.Properties) -> None:
        own, self.density, self.sh = field_from_props(props)
        self.mivol_field: SphericalGrid = own
        self.refresh()
        props["to_world"] = mi.ScalarTransform4f(self.mivol_to_world)
        super().__init__(props)

    def refresh(self) -> None:
        self.mivol_field = self.mivol_field.with_tensors(self.density, self.sh)
        self.dense = self.mivol_field.dense_densities()
        self.refreshed_state = self.state()

    def state(self) -> tuple[int, ...]:
        """The arrays of the parameters, and whether gradients are enabled."""
        return tuple(k for t in (self.density, self.sh) for k in (t.array.index, t.array.index_ad))

    @property
    def mivol_densities(self) -> list[mi.TensorXf]:
        """The density of each level."""
        if self.refreshed_state != self.state():  # gradients may be enabled without an update
            self.refresh()
        return self.dense

    @property
    def mivol_to_world(self) -> np.ndarray:
        """Placement of the whole field: the box of the outermost level."""
        return self.mivol_field.level_to_world(self.mivol_field.levels - 1)

    def eval(self, it: mi.Interaction3f, active: mi.Bool = True) -> mi.Spectrum:
        colour = self.mivol_field.eval_radiance(it.p, -_towards(it), active)
        return mi.Spectrum(mi.luminance(colour)) if mi.is_monochromatic else mi.Spectrum(colour)

    def eval_1(self, it: mi.Interaction3f, active: mi.Bool = True) -> mi.Float:
        return self.mivol_field.eval(it.p, -_towards(it), active)[0]

    def eval_3(self, it: mi.Interaction3f, active: mi.Bool = True) -> mi.Vector3f:
        return mi.Vector3f(self.mivol_field.eval_radiance(it.p, -_towards(it), active))

    def max(self) -> float:
        raise MivolError("a mivol_sh was given as an extinction; give it as the emission of a mivol_medium, and nothing else.")

    def resolution(self) -> mi.ScalarVector3i:
        return mi.ScalarVector3i(self.mivol_field.res[::-1])

    def channel_count(self) -> int:
        return 3

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("density", self.density, mi.ParamFlags.Differentiable)
        callback.put("sh", self.sh, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        self.refresh()

    def to_string(self) -> str:
        f = self.mivol_field
        z, y, x = f.res
        levels = f"{f.levels} levels of " if f.levels > 1 else ""
        return f"mivol_sh[{levels}{x}x{y}x{z}, degree {f.degree}, {f.rows} rows, {f.activation}]"


class TransferVolume(VoxelVolume):
    """``<volume type="mivol_transfer">``: a scalar grid seen through a table, as an extinction or as an emission.

    Parameters:
        filename or data: the scalar grid, a file or a tensor (Z, Y, X, 1); arbitrary finite numbers.
        table: entries at equal steps of the value, 1 or 3 numbers each: ``0, 0, 2, 10`` or ``0 0 0, 1 0.9 0.7``, or a tensor
            (n, C). Differentiable, as is the grid (``scalar``).
        domain: values of the first and the last entry, ``-1000, 2000``. Default: smallest and largest value of the grid.
        refine: nodes per voxel in each direction. Default 1.
        to_world: places the unit cube.
        gradient_opacity: factors on the table's entries at equal steps of the gradient's magnitude, ``0, 1``: in an
            extinction, they keep boundaries and remove interiors. Default none.
        gradient_domain: magnitudes [value per length] of the first and the last factor. Default 0 and the largest of the grid.
        shade: whether the gradient shades an emission like a surface. Default false.
        eye: position of the viewer, ``x, y, z`` in the world; a parameter, for moving cameras.
        light: position of the light. Default at the eye.
        ambient, diffuse, specular, specular_power: terms of the light. Default 0.1, 0.7, 0.2 and 10, as in VTK.
    """

    def __init__(self, props: mi.Properties) -> None:
        self.mivol_transfer = Transfer.from_props(props)
        self.table, self.scalar = self.mivol_transfer.table, self.mivol_transfer.field
        self.field = self.mivol_transfer.voxels
        self.texture = self.field.freezable_texture
        shading = self.mivol_transfer.effects.shading
        self.eye = None if shading is None else shading.eye
        props["to_world"] = mi.ScalarTransform4f(self.field.to_world)
        mi.Volume.__init__(self, props)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("table", self.table, mi.ParamFlags.Differentiable)
        callback.put("scalar", self.scalar, mi.ParamFlags.Differentiable)
        callback.put("data", self.field.tensor, mi.ParamFlags.Differentiable)  # what the table makes of it
        if self.eye is not None:
            callback.put("eye", self.eye, mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        self.mivol_transfer.refresh()


class ExtinctionVolume(mi.Volume):
    """A volume that shows the grey field ``mivol_extinction``, and the parameters of the field.

    Args:
        field: a field of :mod:`mivol.fields.protocol`.
    """

    def __init__(self, props: mi.Properties, field: Field) -> None:
        self.mivol_extinction = field
        props["to_world"] = mi.ScalarTransform4f(field.to_world)
        super().__init__(props)

    def eval(self, it: mi.Interaction3f, active: mi.Bool = True) -> mi.Spectrum:
        return mi.Spectrum(self.eval_1(it, active))

    def eval_1(self, it: mi.Interaction3f, active: mi.Bool = True) -> mi.Float:
        return self.mivol_extinction.eval(it.p, _towards(it), mi.Bool(active))[0]

    def max(self) -> float:
        return max(self.mivol_extinction.bound())

    def channel_count(self) -> int:
        return 1

    def traverse(self, callback: mi.TraversalCallback) -> None:
        for name, value in self.mivol_extinction.parameters().items():
            callback.put(name, value, mi.ParamFlags.Differentiable)


class GaussianVolume(ExtinctionVolume):
    """``<volume type="mivol_gaussians">``: Gaussians for ray tracing.

    As the ``emission`` of a medium they show their colours; as its ``sigma_t`` they are lit.

    Parameters:
        filename: Gaussians (.ply, .spz, .splat, .ksplat), or
        means, log_scales, quaternions, opacity_logits: tensors (N, 3), (N, 3), (N, 4) and (N,), as in files: scales are
            exp(log_scales), opacities logistic(opacity_logits), quaternions (w, x, y, z) of arbitrary length.
        harmonics: tensor (N, K, 3) of colours, K = 1, 4, 9 or 16 harmonics. Default none.
        to_world: places the Gaussians in the world; opacities do not change. Default: the file's place.
        space: space of the colours: srgb (code values, as in fits of photographs), shown as the corresponding radiance, or
            linear (radiance). Default srgb.
        blur: standard deviation of a blur that widens each Gaussian, in the lengths of the file. To match the splats of a fit,
            use the blur of the fit's low-pass filter: sqrt(0.3) times the distance, over the focal length of the photographs
            in pixels. Default 0.

    A ray through a Gaussian loses the light that a splat of the same opacity would hide. Colours are composited in the order
    in which the ray passes the peaks. The tensors are its parameters. The medium's shape should hold all Gaussians; the shape
    cuts off the parts outside.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props, GaussianField.from_props(props))

    def parameters_changed(self, keys: list[str]) -> None:
        self.mivol_extinction.refresh()

    def to_string(self) -> str:
        return f"mivol_gaussians[{self.mivol_extinction.count}]"


class HashVolume(ExtinctionVolume):
    """``<volume type="mivol_hash">``: a hash grid with a small network, as a medium's ``sigma_t``.

    Parameters:
        majorant: largest extinction that the field may take [1/length].
        levels, features, log2_table, coarsest, finest: sizes of the hash grid: levels of ``coarsest`` to ``finest`` cells along
            the longest edge, of at most 2^``log2_table`` rows of 1, 2, 4 or 8 numbers. Default 8, 2, 17, 4 and 32.
        width, layers: neurons of a hidden layer, and hidden layers. Default 16 and 1.
        seed: of the first values. Default 0.
        table, weights_0, weights_1, ...: tensors (rows, features) and (outputs, inputs), in place of the first values.
        nodes: evaluate the network at the nodes of a grid with this number along the longest edge, trilinear between them.
            Steps of a fit are then several times as fast. Default: at the points of the paths, without a grid.
        to_world: places the unit cube.

    The extinction is ``majorant`` times a logistic function, so it stays below for any values. The tensors are its parameters.
    With ``nodes``, ``data`` (Z, Y, X, 1) shows the values at the nodes.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props, HashDensity.from_props(props))

    def to_string(self) -> str:
        field = self.mivol_extinction
        return f"mivol_hash[{field.sizes.levels} levels, {sum(dr.width(value) for value in field.tensors.values())} numbers]"


class TabulatedVolume(VoxelVolume):
    """Voxels that follow the tensors of a hash grid or a NeRF.

    Args:
        density: the field.
        nodes: nodes along the longest edge of the box.
    """

    def __init__(self, props: mi.Properties, density: HashDensity | FittedDensity, nodes: int) -> None:
        self.tabulated = TabulatedDensity(density, nodes)
        self.field = self.tabulated.voxels
        self.texture = self.field.freezable_texture
        props["to_world"] = mi.ScalarTransform4f(self.field.to_world)
        mi.Volume.__init__(self, props)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        for name, value in self.tabulated.density.parameters().items():
            callback.put(name, value, mi.ParamFlags.Differentiable)
        callback.put("data", self.field.tensor, mi.ParamFlags.Differentiable)  # what the network makes of them

    def parameters_changed(self, keys: list[str]) -> None:
        self.tabulated.refresh()

    def to_string(self) -> str:
        return f"{type(self.tabulated.density).__name__}[at {' x '.join(map(str, self.tabulated.res[::-1]))} nodes]"


class NetworkVolume(TabulatedVolume):
    """``<volume type="mivol_network">``: the extinction of a hash grid or a NeRF fitted to photographs, by its weights.

    Parameters:
        filename: a hash grid or a NeRF (.npz), of a fit or from published weights.
        nodes: nodes of a grid along the longest edge of the field's box; the network is evaluated there, trilinear between
            them. Default 64.

    The weights that the density depends on are its parameters: ``table`` and ``density_weights``, or ``weights``. ``data``
    (Z, Y, X, 1) shows the values at the nodes.
    """

    def __init__(self, props: mi.Properties) -> None:
        if "filename" not in props:
            raise MivolError("mivol_network was given no filename: give a hash grid or a NeRF (.npz).")
        path = str(mi.file_resolver().resolve(props["filename"]))
        field = read_field(path)
        if not isinstance(field, SampledField):
            raise MivolError(f"{path} is a {type(field).__name__}, a hash grid or a NeRF is expected: give it as a mivol_sh.")
        super().__init__(props, FittedDensity(field), int(props.get("nodes", 64)))


class OctreeVolume(ExtinctionVolume):
    """``<volume type="mivol_octree">``: constant leaves of an octree, 1 or 3 channels, as ``sigma_t``, ``sigma_a``, ``sigma_s``
    or ``albedo``; vacuum elsewhere. Rays cross it exactly, from leaf to leaf.

    Parameters:
        filename or data: an octree (.npz of mivol or svox: its extinction), or a grid, as a file of a volume or a tensor
            (Z, Y, X, C), of which voxels of 0 are left out and equal ones joined.
        tolerance: largest difference of the voxels in a leaf, over the largest value: eight voxels become one leaf as long as
            they differ less, at most 1. Default 0: only equal voxels.
        to_world: places the unit cube of the grid, or the cube of the octree (default: the file's place).

    The parameter ``data`` (leaves, C) holds the values, at least 0.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props, LeafField.from_props(props))
        self.data = self.mivol_extinction.values

    def eval(self, it: mi.Interaction3f, active: mi.Bool = True) -> mi.Spectrum:
        values = self.mivol_extinction.eval(it.p, None, mi.Bool(active))
        return (
            mi.Spectrum(mi.luminance(mi.Color3f(*values))) if mi.is_monochromatic and len(values) == 3 else mi.Spectrum(*values)
        )

    def eval_3(self, it: mi.Interaction3f, active: mi.Bool = True) -> mi.Vector3f:
        return mi.Vector3f(*self.mivol_extinction.eval(it.p, None, mi.Bool(active)))

    def max_per_channel(self) -> list[float]:
        return self.mivol_extinction.bound()

    def resolution(self) -> mi.ScalarVector3i:
        return mi.ScalarVector3i(1 << self.mivol_extinction.depth)

    def channel_count(self) -> int:
        return self.mivol_extinction.channels

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("data", self.data, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        self.mivol_extinction.values = self.data
        self.mivol_extinction.check()

    def to_string(self) -> str:
        field = self.mivol_extinction
        return f"mivol_octree[{field.leaves} leaves, depth {field.depth}]"


def make_hash_volume(props: mi.Properties) -> HashVolume | TabulatedVolume:
    """A ``mivol_hash``: evaluated at points, or at the nodes of a grid."""
    if "nodes" in props:
        return TabulatedVolume(props, HashDensity.from_props(props), int(props["nodes"]))
    return HashVolume(props)


def _towards(it: mi.Interaction3f) -> mi.Vector3f:
    """Direction to the eye; up for an interaction without a direction."""
    wi = getattr(it, "wi", mi.Vector3f(0, 0, 1))
    return dr.select(dr.squared_norm(wi) > 0, wi, mi.Vector3f(0, 0, 1))


# Mitsuba has no register_volume; a volume registered as a texture is found by <volume>. tests/conformance guards this.
mi.register_texture("mivol_voxels", VoxelVolume)
mi.register_texture("mivol_blackbody", BlackbodyVolume)
mi.register_texture("mivol_sh", SphericalVolume)
mi.register_texture("mivol_transfer", TransferVolume)
mi.register_texture("mivol_hash", make_hash_volume)
mi.register_texture("mivol_gaussians", GaussianVolume)
mi.register_texture("mivol_octree", OctreeVolume)
mi.register_texture("mivol_network", NetworkVolume)
