"""<volume type="mivol_voxels">: a dense grid, for our media and for stock ones."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mivol.fields.voxels import Voxels


class VoxelVolume(mi.Volume):
    """``<volume type="mivol_voxels">``: a trilinear grid, 1 or 3 channels.

    Parameters:
        filename, grid or data: a file (.vol, .npy, .npz, .nrrd, .mhd, .nii, .vti, ...), a ``mi.VolumeGrid`` or a tensor.
        to_world: places the unit cube.
        use_grid_bbox: place the grid by its file's own box first. Default false.
    """

    def __init__(self, props: mi.Properties) -> None:
        self.field = Voxels.from_props(props)
        self.texture = self.field.texture  # dr.freeze finds arrays among a plugin's own attributes only
        props["to_world"] = mi.ScalarTransform4f(self.field.to_world)
        super().__init__(props)

    @property
    def mivol_to_world(self) -> np.ndarray:
        return self.field.to_world

    def eval(self, it: mi.Interaction3f, active: mi.Bool = True) -> mi.Spectrum:
        return mi.Spectrum(*self.field.eval_colour(it.p, active))

    def eval_1(self, it: mi.Interaction3f, active: mi.Bool = True) -> mi.Float:
        return self.field.eval_colour(it.p, active)[0]

    def eval_3(self, it: mi.Interaction3f, active: mi.Bool = True) -> mi.Vector3f:
        return mi.Vector3f(*self.field.eval(it.p, active))

    def eval_n(self, it: mi.Interaction3f, active: mi.Bool = True) -> list[mi.Float]:
        return self.field.eval(it.p, active)

    def max(self) -> float:
        return max(self.field.bound())

    def max_per_channel(self) -> list[float]:
        return self.field.bound()

    def resolution(self) -> mi.ScalarVector3i:
        return mi.ScalarVector3i(self.field.res[::-1])

    def channel_count(self) -> int:
        return self.field.channels

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("data", self.field.texture.tensor(), mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        self.field.refresh()

    def to_string(self) -> str:
        return repr(self.field)


# Mitsuba has no register_volume; a volume registered as a texture is found by <volume>. tests/conformance guards this.
mi.register_texture("mivol_voxels", VoxelVolume)
