r"""The rays of a sensor, the film that averages their radiance, and the transpose from image gradients to ray gradients.

.. math:: I_p = \frac{\sum_s w_{ps} L_s}{\sum_s w_{ps}}

Conventions. The samples of a render are split into passes of at most ``pass_rays`` rays. The film sums all passes before it
divides by the filter weights, so the image depends on the split only through the order of sums, and a render may have more than
the 2^32 samples that one launch can hold. The samples of a sampler that stratifies stay stratified over all passes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.errors import MivolError
from mivol.transport.traversal.random_numbers import Strata

__all__ = ["CameraRays", "RenderSamples", "adjoint_rays", "film_passes", "render_on_film"]


PLAIN, SPREAD, TILED = "none", "spread", "tiled"
"""Layouts of the lanes of a pass: see :func:`film_passes`."""

TILE_EDGE = 4
"""Edge of a tile of pixels: 16 lanes of one packet."""


@dataclass
class RenderSamples:
    """The samples of a render.

    Attributes:
        sensor: its film, filter, crop and sampler are used as they are.
        seed: of the sampler.
        spp: samples a pixel; 0 for the sampler's own count.
        pass_rays: largest number of rays in a pass.
        layout: ``PLAIN``: independent positions in the pixel. ``SPREAD``: the samples of a pixel are stratified over its area.
            ``TILED``: besides, the lanes of a tile of pixels lie side by side, and directions are stratified. The last two need
            an independent sampler, and ``TILED`` a film of whole tiles; elsewhere the layout is the next simpler one.
    """

    sensor: mi.Sensor
    seed: int
    spp: int
    pass_rays: int
    layout: str = PLAIN


@dataclass
class CameraRays:
    """The camera rays of one pass.

    Attributes:
        sampler: what the pass draws its numbers from.
        ray: world space.
        weight: the sensor's importance.
        position: of the sample on the film [pixel].
        on_film: that position as a share of the crop [1]; in [0, 1) but for samples beside it that a wide filter asks for.
        strata: the stratum that each lane draws directions from; None where lanes have none.
    """

    sampler: mi.Sampler
    ray: mi.RayDifferential3f
    weight: mi.Spectrum
    position: mi.Point2f
    on_film: mi.Point2f
    strata: Strata | None = None


RadianceFunction = Callable[[CameraRays], tuple]
"""``sample(rays) -> (radiance, alpha, AOVs)``; alpha in [0, 1] is what the film's alpha sees, without derivatives."""


def film_passes(samples: RenderSamples) -> Iterator[CameraRays]:
    """Generate the rays of a render, pass by pass.

    Raises:
        MivolError: one sample a pixel is more than a launch can hold (2^32).
    """
    base, pixels, per_pass = _plan_passes(samples.sensor, samples.spp, samples.pass_rays)
    base.set_samples_per_wavefront(per_pass)
    for index in range(base.sample_count() // per_pass):
        sampler = base.clone()
        _seed_pass(sampler, samples.seed, index, pixels * per_pass)
        yield _camera_rays(samples, sampler, pixels * per_pass, per_pass)


def _seed_pass(sampler: mi.Sampler, seed: int, index: int, count: int) -> None:
    """Seed a sampler for one pass, so that it does not depend on how much the passes before have drawn.

    A replay may draw fewer numbers than the pass that it repeats.
    """
    if sampler.class_name() == "IndependentSampler":
        sampler.seed(seed if index == 0 else mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(index))[0], count)
        return
    # A sampler that stratifies has one permutation for all passes; ``advance`` moves on in it to the next pass.
    sampler.seed(seed, count)
    for _ in range(index):
        sampler.advance()


def count_passes(sensor: mi.Sensor, spp: int, pass_rays: int) -> int:
    """Number of passes that :func:`film_passes` makes."""
    sampler, _, per_pass = _plan_passes(sensor, spp, pass_rays)
    return sampler.sample_count() // per_pass


def _plan_passes(sensor: mi.Sensor, spp: int, pass_rays: int) -> tuple[mi.Sampler, int, int]:
    """A copy of the sensor's sampler, the number of pixels of the film, and the samples of a pixel in one pass."""
    sampler = sensor.sampler().clone()
    if spp:
        sampler.set_sample_count(spp)
    width, height = _sampled_size(sensor.film())
    pixels = width * height
    if pixels > 2**32:
        raise MivolError(f"a film of {width}x{height} pixels was asked for; a launch holds 2^32: render crops of it.")
    spp = sampler.sample_count()
    room = max(1, pass_rays // pixels)
    return sampler, pixels, max(d for d in range(1, min(room, spp) + 1) if spp % d == 0)


def _sampled_size(film: mi.Film) -> tuple[int, int]:
    """Pixels that are sampled: the crop, and the border that a wide filter may ask for."""
    border = 2 * film.rfilter().border_size() if film.sample_border() else 0
    width, height = film.crop_size()
    return int(width) + border, int(height) + border


def _camera_rays(samples: RenderSamples, sampler: mi.Sampler, count: int, per_pass: int) -> CameraRays:
    sensor, layout = samples.sensor, samples.layout
    film = sensor.film()
    width, height = _sampled_size(film)
    lane, strata = dr.arange(mi.UInt32, count), None
    # Opaque, since a kernel that contains the seed as a literal would be compiled anew in every render.
    salt = mi.UInt32(samples.seed)
    dr.make_opaque(salt)
    salt += 0x9E3779B9
    across = max(a for a in range(1, int(per_pass**0.5) + 1) if per_pass % a == 0)
    shares = layout != PLAIN and sampler.class_name() == "IndependentSampler"
    if layout == TILED and shares and width % TILE_EDGE == 0 and height % TILE_EDGE == 0:
        lanes, tiles = TILE_EDGE * TILE_EDGE, width // TILE_EDGE
        tile, rest = lane // (lanes * dr.opaque(mi.UInt32, per_pass)), lane % (lanes * dr.opaque(mi.UInt32, per_pass))
        sample, inside = rest // lanes, rest % lanes
        pixel = mi.Vector2i(TILE_EDGE * (tile % tiles) + inside % TILE_EDGE, TILE_EDGE * (tile // tiles) + inside // TILE_EDGE)
        turn, other = mi.sample_tea_32(tile, salt)
        strata = Strata((sample + turn % per_pass) % per_pass, across, per_pass // across)
    else:
        index, sample = lane // dr.opaque(mi.UInt32, per_pass), lane % dr.opaque(mi.UInt32, per_pass)
        pixel = mi.Vector2i(index % width, index // width)
        _, other = mi.sample_tea_32(index, salt)
    if film.sample_border():
        pixel -= film.rfilter().border_size()
    pixel += mi.Vector2i(film.crop_offset())
    u = sampler.next_2d()
    if shares:
        # The strata of a pixel are visited in another order in each tile (or pixel); otherwise each stratum of directions would
        # be tied to one part of the pixel.
        cell = mi.permute_kensler(sample, per_pass, other)
        u = Strata(cell, across, per_pass // across).jitter(u)
    position = mi.Vector2f(pixel) + u

    scale = dr.rcp(mi.ScalarVector2f(film.crop_size()))
    offset = -mi.ScalarVector2f(film.crop_offset()) * scale
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0)
    time = mi.Float(sensor.shutter_open())
    if sensor.shutter_open_time() > 0:
        time += sampler.next_1d() * sensor.shutter_open_time()
    on_film = dr.fma(position, scale, offset)
    ray, weight = sensor.sample_ray_differential(time, mi.Float(0), on_film, aperture)
    # A box filter gives a sample to its pixel, whatever its position in it.
    place = mi.Vector2f(pixel) if film.rfilter().is_box_filter() else position
    return CameraRays(sampler, ray, weight, place, mi.Point2f(on_film), strata)


def render_on_film(samples: RenderSamples, names: list[str], sample: RadianceFunction) -> mi.TensorXf:
    """Render an image: sample the rays of all passes, and average them on the sensor's film.

    Args:
        samples: of the render.
        names: of the AOVs, in the order in which ``sample`` returns them.
        sample: :data:`RadianceFunction`.

    Returns:
        (height, width, colours + AOVs).
    """
    film = samples.sensor.film()
    film.prepare(names)
    for rays in film_passes(samples):
        L, alpha, aovs = sample(rays)
        block = _new_block(film, rays)
        _add_samples(block, film, rays, _FilmSample(L * rays.weight, mi.Float(1), alpha, aovs))
        film.put_block(block)
        dr.eval(block.tensor())
        del L, alpha, aovs, rays, block
    return film.develop()


def adjoint_rays(
    samples: RenderSamples, names: list[str], grad_image: mi.TensorXf
) -> Iterator[tuple[CameraRays, mi.Spectrum, list[mi.Float]]]:
    """Turn a gradient image into a gradient for each ray, pass by pass: the transpose of the film.

    Args:
        samples, names: as :func:`render_on_film`.
        grad_image: d loss / d image.

    Yields:
        The rays of a pass, d loss / d L of each, and d loss / d AOV.
    """
    film = samples.sensor.film()
    several = count_passes(samples.sensor, samples.spp, samples.pass_rays) > 1
    weights = _sum_filter_weights(samples, names) if several else None
    for rays in film_passes(samples):
        with dr.resume_grad():
            n = dr.width(rays.ray)
            L = dr.full(mi.Spectrum, 1, n)
            aovs = [dr.ones(mi.Float, n) for _ in names]
            dr.enable_grad(L, aovs)
            film.prepare(names)
            block = _new_block(film, rays)
            # A pixel is divided by the filter weights of all passes. Where there are several, the weights are therefore summed
            # beforehand, in a block of their own.
            weight = mi.Float(0 if several else 1)
            _add_samples(block, film, rays, _FilmSample(L * rays.weight, weight, mi.Float(0), aovs))
            film.put_block(block)
            if several:
                film.put_block(weights)
            image = film.develop()
            dr.set_grad(image, grad_image)
            dr.enqueue(dr.ADMode.Backward, image)
            dr.traverse(dr.ADMode.Backward)
            dL, daovs = dr.grad(L), [dr.grad(a) for a in aovs]
        film.clear()
        dr.eval(dL, daovs)
        yield rays, dL, daovs


def _sum_filter_weights(samples: RenderSamples, names: list[str]) -> mi.ImageBlock:
    """An image block with the filter weights of all passes and no light."""
    film = samples.sensor.film()
    film.prepare(names)
    block = None
    for rays in film_passes(samples):
        block = block or _new_block(film, rays)
        zero = [mi.Float(0) for _ in names]
        _add_samples(block, film, rays, _FilmSample(mi.Spectrum(0), mi.Float(1), mi.Float(0), zero))
        dr.eval(block.tensor())
    return block


def _new_block(film: mi.Film, rays: CameraRays) -> mi.ImageBlock:
    block = film.create_block()
    # Coalescing sums the samples of a pixel before it writes them. It pays from 4 samples on (Mitsuba's own rule), and needs
    # them in neighbouring lanes, which tiles do not give.
    block.set_coalesce(block.coalesce() and rays.sampler.sample_count() >= 4 and rays.strata is None)
    return block


@dataclass
class _FilmSample:
    """What a ray adds to the film.

    Attributes:
        L: radiance times the sensor's importance.
        weight: what its filter weight is multiplied with in the sum that the film divides by.
        alpha, aovs: alpha, and the AOVs in their order.
    """

    L: mi.Spectrum
    weight: mi.Float
    alpha: mi.Float
    aovs: list[mi.Float]


def _add_samples(block: mi.ImageBlock, film: mi.Film, rays: CameraRays, sample: _FilmSample) -> None:
    """Add samples to a block, in the order of channels of the film."""
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        count = block.channel_count()
        how = {"weight": sample.weight, "alpha": sample.alpha}
        block.put(rays.position, film.prepare_sample(sample.L, rays.ray.wavelengths, count, **how))
        return
    colour = mi.Color3f(sample.L.x) if mi.is_monochromatic else sample.L
    head = [colour.x, colour.y, colour.z]
    if mi.has_flag(film.flags(), mi.FilmFlags.Alpha):
        head.append(sample.alpha)
    block.put(rays.position, [*head, sample.weight, *sample.aovs])
