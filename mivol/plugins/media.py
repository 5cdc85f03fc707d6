"""<medium type="mivol_medium">: extinction and albedo, or absorption and scattering, each a number, rgb or a grid."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.kernel_recording import is_recording
from mivol.scene.coefficients import Coefficients, check_constant


class MivolMedium(mi.Medium):
    """``<medium type="mivol_medium">``: a participating medium.

    Parameters:
        sigma_t, albedo: extinction [1/length] and single-scattering albedo (default 0), or
        sigma_a, sigma_s: absorption and scattering [1/length]; each a float, rgb (above 1 allowed) or a volume.
        scale: factor on the extinction, differentiable. Default 1.
        emission: radiance Le of an opaque part of the medium (the source function is (1 - albedo) Le), a float, rgb or a
            volume; its voxels may be an eighth of the extinction's, in any place. A ``mivol_sh`` brings its own extinction:
            give nothing else with it. Default none.
        emission_density: emitted radiance per length, independent of the extinction, in the same forms. Default none.
        a phase function: default isotropic.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.coefficients = Coefficients.from_props(props)
        # dr.freeze finds arrays only among a plugin's own attributes.
        self.volumes = {**self.coefficients.volumes, **self.coefficients.lights}
        self.scale = mi.Float(props.get("scale", 1.0))
        dr.make_opaque(self.scale)
        self.m_is_homogeneous = self.coefficients.is_homogeneous
        self.m_has_spectral_extinction = self.coefficients.is_rgb
        self.refresh()

    def refresh(self) -> None:
        if not is_recording():
            self.coefficients.check_constants()
            check_constant(self.scale, "scale", " of a mivol_medium")
        self.majorant = self.coefficients.bound()
        dr.make_opaque(self.majorant)

    def intersect_aabb(self, ray: mi.Ray3f) -> tuple[mi.Bool, mi.Float, mi.Float]:
        return self.coefficients.reach(ray)

    def get_majorant(self, mei: mi.MediumInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
        return self.scale * self.majorant

    def get_scattering_coefficients(
        self, mei: mi.MediumInteraction3f, active: mi.Bool = True
    ) -> tuple[mi.Spectrum, mi.Spectrum, mi.Spectrum]:
        return self.coefficients.eval(mei, self.scale, self.majorant, active)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        if not self.coefficients.is_field:
            callback.put("scale", self.scale, mi.ParamFlags.Differentiable)
        for name, volume in self.volumes.items():
            callback.put(name, volume, mi.ParamFlags.Differentiable)
        super().traverse(callback)

    def parameters_changed(self, keys: list[str]) -> None:
        self.refresh()

    def to_string(self) -> str:
        return repr(self.coefficients)


mi.register_medium("mivol_medium", MivolMedium)
