r"""Splats of a tile composited front to back, and the derivatives by every splat, without a division.

Each tile of 8 x 8 pixels is 16 lanes of 2 x 2 pixels; all lanes of a tile walk the same list. With u_i = 1 - alpha_i,

.. math:: L = \sum_i T_i \alpha_i c_i, \qquad T_i = \prod_{j<i} u_j, \qquad
   \frac{dL}{d\alpha_i} = T_i (c_i - \rho_i), \qquad \rho_{i-1} = \alpha_i c_i + u_i \rho_i

T runs from the front and rho from the back, so either T or rho has to be stored. The forward pass writes down T once in
``CHUNK`` entries. The backward pass takes the chunks from the last to the first, and recomputes T within a chunk. The usual
way, T_i = T_{i+1} / u_i, loses its digits for alpha near 1, and has no digits at 1.

**The end of a lane.** A lane does not stop at T below ``STOP``. Behind a splat of alpha = 1 everything is hidden, but
dL/dalpha of this splat is c minus the colour behind the splat. A lane stops where M, the product of all u but the smallest, is
below ``STOP``. Every derivative leaves out at most its own u, so the neglected part of L is below STOP times the largest
colour, and so is the neglected part of each c_i - rho_i, times T_i.

Conventions. Lanes count tiles in the given order. The numbers of the lanes of a tile follow its blocks of 2 x 2 pixels row by
row; the numbers of a block follow its pixels. Colours are channels: rgb, and the depth on request. A splat is skipped in a
pixel where its alpha is below ``grid.least``.

References: Kerbl et al. 2023.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.splatting.projection import EXP2, TILE, TileGrid

CHUNK = 4
"""Entries between two stored values of T."""

BLOCK = 2
"""Pixels along the edge of the block of a lane."""

PIXELS = BLOCK * BLOCK
LANES = (TILE // BLOCK) ** 2

STOP = 1e-4

HALF = 0.5
"""T crossed by the median depth."""


@dataclass
class Lists:
    """Lists of tiles on the device.

    Attributes:
        entries: indices of splats.
        starts: beginning of the list of a tile, one number more than tiles.
        chunks: beginning of the chunks of a tile, one number more than tiles.
        tiles: the order for drawing tiles.
    """

    entries: mi.UInt32
    starts: mi.UInt32
    chunks: mi.UInt32
    tiles: mi.UInt32


@dataclass
class Frame:
    """The image, flat.

    Attributes:
        width, height: [pixel].
        image: receives rgb, depth on request, and alpha of each pixel.
        transmittance: receives T of the pixels of each lane at the beginning of each chunk.
        depth: whether the depth is a channel.
        median: whether this channel is the depth of the splat at which T falls below a half, instead of the mean times alpha.
        remembers: whether T is written down.
        discs: whether a splat is the inside of its ellipse of one standard deviation, instead of a Gaussian.
    """

    width: mi.UInt32
    height: mi.UInt32
    image: mi.Float
    transmittance: mi.Float
    depth: bool
    median: bool
    remembers: bool
    discs: bool


@dataclass
class Adjoint:
    """Derivatives by the image, and by the splats.

    Attributes:
        image: derivative by each number of the image.
        chunks: number of chunks drawn by each lane.
        shape: eight numbers a splat: the sums of :func:`_moments`, red, green.
        rest: two numbers a splat: blue, depth.
    """

    image: mi.Float
    chunks: mi.UInt32
    shape: mi.Float
    rest: mi.Float


@dataclass
class _Lane:
    """The list and the pixels of a lane."""

    start: mi.UInt32
    count: mi.UInt32
    chunk: mi.UInt32
    number: mi.UInt32
    x: mi.UInt32
    y: mi.UInt32

    @classmethod
    def of(cls, lists: Lists, grid: TileGrid) -> _Lane:
        lane = dr.arange(mi.UInt32, dr.width(lists.tiles) * LANES)
        tile = dr.gather(mi.UInt32, lists.tiles, lane // LANES)
        start = dr.gather(mi.UInt32, lists.starts, tile)
        count = dr.gather(mi.UInt32, lists.starts, tile + 1) - start
        number, columns, along = lane % LANES, mi.UInt32(grid.columns), TILE // BLOCK
        x = (tile % columns) * TILE + (number % along) * BLOCK
        y = (tile // columns) * TILE + (number // along) * BLOCK
        return cls(start, count, dr.gather(mi.UInt32, lists.chunks, tile), number, x, y)

    def pixels(self, width: mi.UInt32, height: mi.UInt32) -> list[tuple[mi.UInt32, mi.Bool]]:
        """Index in the image of each pixel, and whether the pixel is inside."""
        at = [(self.x + p % BLOCK, self.y + p // BLOCK) for p in range(PIXELS)]
        return [(y * width + x, (x < width) & (y < height)) for x, y in at]

    def transmittance(self, chunk: mi.UInt32) -> mi.UInt32:
        """Position of the stored T of the pixels of this lane."""
        return (self.chunk + chunk) * LANES + self.number

    def splat(self, lists: Lists, at: mi.UInt32) -> tuple[mi.UInt32, mi.Bool]:
        """The splat of an entry of the list, and whether the entry exists."""
        there = at < self.count
        return dr.gather(mi.UInt32, lists.entries, self.start + at, there), there


@dataclass
class _Footprint:
    """A splat on the pixels of a lane."""

    dx: list[mi.Float]
    dy: list[mi.Float]
    xx: mi.Float
    xy: mi.Float
    yy: mi.Float
    opacity: mi.Float
    falloff: list[mi.Float]
    alpha: list[mi.Float]
    drawn: list[mi.Bool]
    colour: list[mi.Float]

    @classmethod
    def of(cls, shape: mi.Float, index: mi.UInt32, there: mi.Bool, lane: _Lane, grid: TileGrid, discs: bool) -> _Footprint:
        x, y, xx, xy, yy, opacity, *colour = dr.gather(mi.ArrayXf, shape, index, there, shape=(8, dr.width(index)))
        dx = [mi.Float(lane.x) + (0.5 + p) - x for p in range(BLOCK)]
        dy = [mi.Float(lane.y) + (0.5 + p) - y for p in range(BLOCK)]
        q = [dr.fma(xx * a, a, dr.fma(xy * a, b, yy * b * b)) for b in dy for a in dx]
        if discs:
            slopes = [(2 * xx * a + xy * b, 2 * yy * b + xy * a) for b in dy for a in dx]
            falloff = [_covered(value, *slope) for value, slope in zip(q, slopes, strict=True)]
        else:
            falloff = [dr.exp2(value) for value in q]
        alpha = [opacity * value for value in falloff]
        drawn = [there & (value >= grid.least) for value in alpha]
        alpha = [dr.select(d, value, 0) for d, value in zip(drawn, alpha, strict=True)]
        return cls(dx, dy, xx, xy, yy, opacity, falloff, alpha, drawn, colour)


def _covered(q: mi.Float, q_x: mi.Float, q_y: mi.Float) -> mi.Float:
    """Share of a pixel covered by the ellipse of one standard deviation, to first order in its distance from the border.

    m = sqrt(q / EXP2) is 1 on the border, and (1 - m) / |grad m| is the distance from the border [pixel]. The share falls from
    1 to 0 between half a pixel inside and half a pixel outside, like the share of a pixel cut by a straight border parallel to
    its edges.
    """
    m = dr.sqrt(q * (1 / EXP2))
    slope = dr.sqrt(q_x * q_x + q_y * q_y) * dr.rcp(-2 * EXP2 * dr.maximum(m, 1e-6))
    return dr.clip(0.5 + (1 - m) * dr.rcp(dr.maximum(slope, 1e-9)), 0, 1)


def _gather_blue_and_depth(rest: mi.Float, index: mi.UInt32, there: mi.Bool, depth: bool) -> list[mi.Float]:
    """Blue, and the depth on request."""
    if depth:
        return list(dr.gather(mi.ArrayXf, rest, index, there, shape=(2, dr.width(index))))
    return [dr.gather(mi.Float, rest, index * 2, there)]


def composite(
    splats: tuple[mi.Float, mi.Float], lists: Lists, grid: TileGrid, frame: Frame
) -> tuple[mi.Float, mi.UInt32, mi.Float]:
    """Composite all tiles.

    Args:
        splats: eight and two numbers a splat (:class:`mivol.splatting.projection.Splats`).
        lists: the splats of each tile.
        grid: the tiles.
        frame: the image, and the store of T.

    Returns:
        The image, flat (rgb, depth on request, alpha); the number of chunks drawn by each lane; T at the beginnings of the
        chunks.
    """
    shape, rest = splats
    lane = _Lane.of(lists, grid)
    channels = 4 if frame.depth else 3

    def step(chunk: mi.UInt32, clear: list, most: list, colour: list) -> tuple:
        if frame.remembers:
            dr.scatter(frame.transmittance, mi.ArrayXf(_product(clear, most)), lane.transmittance(chunk))
        for k in range(CHUNK):
            index, there = lane.splat(lists, chunk * CHUNK + k)
            footprint = _Footprint.of(shape, index, there, lane, grid, frame.discs)
            splat_colour = footprint.colour + _gather_blue_and_depth(rest, index, there, frame.depth)
            for p in range(PIXELS):
                a, u = footprint.alpha[p], 1 - footprint.alpha[p]
                weight = a * clear[p] * most[p]
                for c in range(3 if frame.median else channels):
                    colour[p][c] = dr.fma(weight, splat_colour[c], colour[p][c])
                if frame.median:
                    through = clear[p] * most[p]
                    colour[p][3] = dr.select((through >= HALF) & (through * u < HALF), splat_colour[3], colour[p][3])
                clear[p], most[p] = clear[p] * dr.maximum(most[p], u), dr.minimum(most[p], u)
        return chunk + 1, clear, most, colour

    def goes_on(chunk: mi.UInt32, clear: list, most: list, colour: list) -> mi.Bool:
        largest = dr.maximum(dr.maximum(clear[0], clear[1]), dr.maximum(clear[2], clear[3]))
        return (chunk * CHUNK < lane.count) & (largest >= STOP)

    one, zero = [mi.Float(1) for _ in range(PIXELS)], [[mi.Float(0) for _ in range(channels)] for _ in range(PIXELS)]
    state = (mi.UInt32(0), one, list(one), zero)
    chunk, clear, most, colour = dr.while_loop(state, goes_on, step, label="composite")
    for p, (pixel, inside) in enumerate(lane.pixels(frame.width, frame.height)):
        values = [*colour[p], 1 - clear[p] * most[p]]
        for c, value in enumerate(values):
            dr.scatter(frame.image, value, pixel * len(values) + c, inside, mode=dr.ReduceMode.Permute)
    return frame.image, chunk, frame.transmittance


def composite_adjoint(
    splats: tuple[mi.Float, mi.Float], lists: Lists, grid: TileGrid, frame: Frame, adjoint: Adjoint
) -> Adjoint:
    """Take the derivative by an image back to the numbers of every splat.

    Args:
        splats, lists, grid, frame: arguments of :func:`composite`, in a call that stored T.
        adjoint: the derivative by the image, the results of :func:`composite`, and the arrays for the derivatives.
    """
    shape, rest = splats
    lane = _Lane.of(lists, grid)
    channels = 5 if frame.depth else 4
    d_pixels = [
        [dr.gather(mi.Float, adjoint.image, pixel * channels + c, inside) for c in range(channels)]
        for pixel, inside in lane.pixels(frame.width, frame.height)
    ]
    number = dr.arange(mi.UInt32, dr.width(adjoint.chunks))
    first = dr.gather(mi.UInt32, adjoint.chunks, number)

    def step(left: mi.UInt32, behind: list) -> tuple:
        chunk = left - 1
        t = list(dr.gather(mi.ArrayXf, frame.transmittance, lane.transmittance(chunk), shape=(PIXELS, dr.width(chunk))))
        chunk_splats = []
        for k in range(CHUNK):
            index, there = lane.splat(lists, chunk * CHUNK + k)
            footprint = _Footprint.of(shape, index, there, lane, grid, frame.discs)
            chunk_splats.append((index, there, footprint, list(t)))
            t = [t[p] * (1 - footprint.alpha[p]) for p in range(PIXELS)]
        for index, there, footprint, t in reversed(chunk_splats):
            splat_colour = [*footprint.colour, *_gather_blue_and_depth(rest, index, there, frame.depth)]
            d_alpha, d_colour = [], [mi.Float(0) for _ in splat_colour]
            for p in range(PIXELS):
                value = d_pixels[p][-1]
                for c, colour in enumerate(splat_colour):
                    value = dr.fma(d_pixels[p][c], colour, value)
                d_alpha.append(dr.select(footprint.drawn[p], t[p] * (value - behind[p]), 0))
                weight = t[p] * footprint.alpha[p]
                d_colour = [dr.fma(weight, d_pixels[p][c], d) for c, d in enumerate(d_colour)]
                behind[p] = dr.fma(footprint.alpha[p], value - behind[p], behind[p])
            sums = _moments(footprint, d_alpha)
            dr.scatter_add(adjoint.shape, mi.ArrayXf([*sums, *d_colour[:2]]), index, there, mode=dr.ReduceMode.Expand)
            dr.scatter_add(adjoint.rest, mi.ArrayXf([*d_colour[2:], mi.Float(0)][:2]), index, there, mode=dr.ReduceMode.Expand)
        return chunk, behind

    state = (first, [mi.Float(0) for _ in range(PIXELS)])
    dr.while_loop(state, lambda left, _: left > 0, step, label="composite adjoint")
    return adjoint


def _product(a: list[mi.Float], b: list[mi.Float]) -> list[mi.Float]:
    return [x * y for x, y in zip(a, b, strict=True)]


def _moments(footprint: _Footprint, d_alpha: list[mi.Float]) -> list[mi.Float]:
    """Sums over the pixels of d L / d exponent times dx, dy, dx^2, dx dy, dy^2, and the derivative by the opacity."""
    e = [d * a for d, a in zip(d_alpha, footprint.alpha, strict=True)]
    (x0, x1), (y0, y1) = footprint.dx, footprint.dy
    left, right, top, bottom = e[0] + e[2], e[1] + e[3], e[0] + e[1], e[2] + e[3]
    ax, bx, ay, by = left * x0, right * x1, top * y0, bottom * y1
    xy = dr.fma(y0, dr.fma(e[0], x0, e[1] * x1), y1 * dr.fma(e[2], x0, e[3] * x1))
    opacity = sum(d * f for d, f in zip(d_alpha, footprint.falloff, strict=True))
    return [ax + bx, ay + by, ax * x0 + bx * x1, xy, ay * y0 + by * y1, opacity]
