"""A camera that takes the numbers of Mitsuba's cameras, for recordings (:mod:`mivol.scene.stand_in`); no plugin for scenes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


class CopiedCamera(mi.Sensor):
    """An orthographic camera or a thin lens. Mitsuba 3.9.1 hides the arrays of its own ones from Dr.Jit.

    Attributes:
        to_world: matrix from the camera to the world.
        to_camera: matrix from the film, [0, 1]^2, to the plane at ``near``.
        near, far: depths between which rays run [length].
        radius, focus: radius of the lens, and depth of the plane in focus [length]; None for parallel rays.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.m_needs_sample_3 = props["on_lens"]

    def take_lens(
        self, near: mi.Float, far: mi.Float, x_fov: mi.Float | None = None,
        aperture_radius: mi.Float | None = None, focus_distance: mi.Float | None = None,
    ) -> None:  # fmt: skip
        """Take all numbers of a camera but its place; its parameters have the same names."""
        film = self.film()
        window = film.size(), film.crop_size(), film.crop_offset()
        if x_fov is None:
            on_film = mi.orthographic_projection(*window, near, far)
        else:
            on_film = mi.perspective_projection(*window, x_fov, near, far)
        self.to_camera, self.near, self.far = on_film.inverse().matrix, near, far
        self.radius, self.focus = aperture_radius, focus_distance
        dr.eval(self.to_camera)

    def sample_ray_differential(
        self, time: mi.Float, wavelength: mi.Float, on_film: mi.Point2f, aperture: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """As Mitsuba's camera, to the bit, but without differentials, which no estimator reads."""
        ray = dr.zeros(mi.RayDifferential3f)
        ray.time = time
        ray.wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), wavelength, active)
        to_world = mi.AffineTransform4f(self.to_world)
        near = mi.ProjectiveTransform4f(self.to_camera) @ mi.Point3f(on_film.x, on_film.y, 0)
        if self.radius is None:
            ray.o, ray.d = to_world @ near, dr.normalize(to_world @ mi.Vector3f(0, 0, 1))
            ray.maxt = self.far - self.near
            return ray, weight
        on_lens = self.radius * mi.warp.square_to_uniform_disk_concentric(aperture)
        lens = mi.Point3f(on_lens.x, on_lens.y, 0)
        # All rays of a point on the film meet in the plane in focus, where the ray through the middle of the lens does.
        direction = dr.normalize(mi.Vector3f(near * (self.focus / near.z) - lens))
        per_depth = dr.rcp(direction.z)
        start = self.near * per_depth
        ray.d = to_world @ direction
        ray.o = to_world @ lens + ray.d * start
        ray.maxt = self.far * per_depth - start
        return ray, weight

    def sample_ray(
        self, time: mi.Float, wavelength: mi.Float, on_film: mi.Point2f, aperture: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """The same rays. A ``batch`` of another scene calls the cameras of the whole process by this name."""
        ray, weight = self.sample_ray_differential(time, wavelength, on_film, aperture, active)
        return mi.Ray3f(ray), weight


mi.register_sensor("mivol_copied_camera", CopiedCamera)
