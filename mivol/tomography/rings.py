"""Faults of pixels: rings, steps between the columns of a sinogram by gains that the flats do not have; and zingers.

:func:`remove_rings` removes them from line integrals alone. :class:`PixelGains` makes what is left an unknown of the fit.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter, median_filter, minimum_filter, uniform_filter1d
from scipy.sparse import diags_array, eye_array
from scipy.sparse.linalg import splu, spsolve
from scipy.special import stdtrit

from mivol.errors import MivolError
from mivol.tomography.preprocess import LightDrift, Transmission, fit_light_drift, interpolate_gaps

RING_WIDTHS = {"gain": 14, "sort": 7}
"""Default width [column] by method, chosen by a head and forty ellipsoids in 129 columns with gains of 2 %: 6 and 10 leave more
rings of the head, 20 and 30 take more of the ellipsoids for gains; 7 has the least error of the head among 3 to 21."""

FIRST_WIDTH = 5
"""Width of the removal that :class:`PixelGains` begins with: of a wider one, the fit undoes too little where it took ellipsoids
for gains."""

GAIN_PERIOD = 90
"""Period along the detector [column] of which half is found; 60 leaves more rings of ellipsoids (1.45 for 1.3 times the error
without rings), with 150 a dense head loses more of its skull."""

EDGE_BEND = 5.0
"""Bend of an edge of the object, over the robust standard deviation of all bends."""


ARCS, FEWEST_ARCS, VIEWS_OF_ARC = 9, 3, 16
"""Arcs of successive views that tell gains from the object: at most, at least, and the fewest views of an arc."""

GAIN_DEVIATIONS = 3.0
"""Standard errors above which gains count as found; scans without rings have up to 1.6."""

COLUMN_CHANCE = 1e-5
"""Probability of an offset above which a single column counts as a gain: of nine arcs 5.1 deviations (6 leave more rings), of
three 8.1."""

LEAST_DRIFT = 0.5
"""Variance of slopes over time, over that of their errors, below which a drift is not subtracted. Scans without drift have up
to 0.3, because their volume does not explain everything; a drift of 0.4 hardly raises the error of a volume."""

LARGE_DRIFT = 5.0
"""Largest number of deviations of a slope in the variance of all slopes."""

ROUNDING = 1e-10
"""Deviation of an offset by rounding, at least."""

ERROR_COLUMNS = 5
"""Columns over which the variance of an offset's error is averaged."""


def remove_rings(y: np.ndarray, weights: np.ndarray, method: str, width: int) -> np.ndarray:
    r"""Remove steps between columns, such as of pixels whose gain the flats do not have: they make rings in the slices.

    Neighbouring columns see nearly the same values in another order. So the values of each column of a row are sorted over the
    views, :math:`s_{k,c}` of rank k, and compared along the detector.

    ``"gain"`` subtracts one number o from each column, the line integral :math:`-\log g` of a constant gain g: first the median
    over the ranks of the steps from the median of w / 4 columns; then, for gains that vary slowly along the detector,

    .. math:: o = \arg\min_o \; |o|^2 + (w / 2 \pi)^4 \sum_c (o_{c-1} - 2 o_c + o_{c+1} - d_c)^2, \qquad
              d_c = \mathrm{median}_k\, (s_{k,c-1} - 2 s_{k,c} + s_{k,c+1})

    because an object bends little between columns. The sum leaves out edges, whose bends exceed ``EDGE_BEND`` deviations of all
    bends. About half of a gain with a period of w along the detector is removed, and more of a shorter one.

    With 48 views or more, o is also found in arcs of the scan. A gain is the same in all arcs; details of the object move. So o
    is reduced to its share on which the arcs agree, and to 0 in a row whose arcs agree only by chance (empirical Bayes). The
    arcs must agree at a width of ``FIRST_WIDTH`` too, where the offsets of gains agree and few details of the object do.

    ``"sort"`` replaces the value of rank k by the median of :math:`s_{k,\cdot}` over w columns; the outermost column continues
    beyond the edges. A row in which ``"gain"`` finds nothing keeps its values.

    Args:
        y: line integrals (views, rows, cols).
        weights: inverse variances; a pixel of weight 0 keeps its value, and counts as interpolated in its row.
        method: key of ``RING_WIDTHS``.
        width: columns w, from 3 to all; odd for "sort".

    Returns:
        Line integrals (views, rows, cols) float64.

    Bias: a detail that all views see at the same column, such as a tube about the axis, counts as a ring and is lost in part.

    Raises:
        MivolError: another width.

    References: "sort": Vo, Atwood & Drakopoulos 2018, Opt. Express 26, 28396, algorithm 3. Penalised second differences, for
    "gain": Eilers 2003, Anal. Chem. 75, 3631.
    """
    columns = y.shape[2]
    if not 3 <= width <= columns or (method == "sort" and width % 2 == 0):
        kind = "an odd number" if method == "sort" else "a number"
        expected = f"{kind} from 3 to the {columns} columns"
        raise MivolError(f"found a ring width of {width}, expected {expected}: set data.ring_width.")
    seen = interpolate_gaps(y, weights)
    # Row by row: ranks and sorted values take three times the memory of what is sorted.
    correct = {"gain": _subtract_gains, "sort": _smooth_striped}[method]
    corrected = np.stack([correct(seen[:, row], width) for row in range(y.shape[1])], axis=1)
    return np.where(weights > 0, corrected, y)


def _subtract_gains(y: np.ndarray, width: int) -> np.ndarray:
    """A row (views, cols) without the steps of constant gains."""
    offsets, arcs = _find_offsets(y, width), min(ARCS, len(y) // VIEWS_OF_ARC)
    if arcs >= FEWEST_ARCS:
        parts = np.array_split(y, arcs)
        narrow = np.stack([_find_offsets(part, min(width, FIRST_WIDTH)) for part in parts])
        offsets *= _share_of_gains(np.stack([_find_offsets(part, width) for part in parts]), _exceeds_chance(narrow))
    return y - offsets


def _exceeds_chance(offsets: np.ndarray) -> bool:
    """Whether the offsets of arcs of the scan (arcs, cols) agree better than by chance.

    A gain is the same in all arcs; a detail of the object moves to other columns. So without gains the variance of the mean
    offset follows from the variance between arcs. Gains of pixels also show in a narrow width, in which neighbouring offsets
    are independent and few details of the object are left.
    """
    excess = _excess(offsets)
    return bool(excess.mean() > GAIN_DEVIATIONS * excess.std() / np.sqrt(len(excess)))


def _excess(offsets: np.ndarray) -> np.ndarray:
    """The squares of the mean offsets of arcs (arcs, cols), less the variances of their errors: (cols,)."""
    return np.mean(offsets, axis=0) ** 2 - np.var(offsets, axis=0, ddof=1) / len(offsets)


def _share_of_gains(offsets: np.ndarray, have_all: bool) -> np.ndarray:
    """Share of each column's offset that gains explain, from its offsets in arcs of the scan (arcs, cols).

    Args:
        offsets: in arcs of the scan.
        have_all: whether all columns have gains; else only single ones, each above chance.
    """
    variances = np.var(offsets, axis=0, ddof=1) / len(offsets)
    true = max(_excess(offsets).mean(), 0.0) if have_all else 0.0
    return _share_above_chance(np.mean(offsets, axis=0), variances, true, len(offsets))


def _share_above_chance(found: np.ndarray, variances: np.ndarray, true: float, arcs: int) -> np.ndarray:
    """Share of each pixel's value above the error (empirical Bayes).

    The best linear estimate of a true value is the found one times ``true / (true + error)``, with the variance of both.

    A few faulty columns hardly raise the variance of all. So a column counts for itself if its value has a chance below
    ``COLUMN_CHANCE`` by its own error.

    Args:
        found: (..., cols).
        variances: variances of the errors, from ``arcs`` of the scan; they are averaged over ``ERROR_COLUMNS``.
        true: variance of the true values: the mean square of the found values less the mean of ``variances``; 0 if that is
            chance.

    Returns:
        (..., cols); without ``true``, 0 in all but such columns.
    """
    squares = found**2
    # Arcs of a noiseless scan may agree to rounding.
    errors = np.maximum(uniform_filter1d(variances, ERROR_COLUMNS, mode="nearest"), ROUNDING**2)
    # Few arcs may agree by chance in a few neighbours: an error counts as at least the median of all.
    is_own = squares > stdtrit((arcs - 1) * ERROR_COLUMNS, COLUMN_CHANCE / 2) ** 2 * np.maximum(errors, np.median(variances))
    own = np.where(is_own, 1 - errors / np.where(is_own, squares, 1), 0)
    return np.maximum(true / (true + errors), own)


def fit_drift_above_chance(residual: np.ndarray, weights: np.ndarray, times: np.ndarray) -> LightDrift:
    """Fit each pixel's drift and reduce it to its share above chance; 0 if the light does not change over time.

    Fits that leave out one arc of the scan each tell the errors of noise and of what the volume does not explain (jackknife).

    Args:
        residual, weights, times: as in :func:`mivol.tomography.preprocess.fit_light_drift`, of six views or more; fewer have
            no drift.
    """
    arcs = min(ARCS, len(times) // 2)
    if arcs < FEWEST_ARCS:
        return LightDrift(*np.zeros((2, *residual.shape[1:])))
    parts = np.array_split(np.arange(len(times)), arcs)
    fits = [fit_light_drift(*(np.delete(a, part, 0) for a in (residual, weights, times))) for part in parts]
    drift = fit_light_drift(residual, weights, times)

    def share(name: str) -> np.ndarray:
        variances = (arcs - 1) ** 2 / arcs * np.var([getattr(fit, name) for fit in fits], axis=0, ddof=1)
        found, error = getattr(drift, name), variances.mean()
        # Single pixels of large drift count for themselves.
        true = np.minimum(found**2, LARGE_DRIFT**2 * error).mean() - error
        # The mean square of n normal numbers scatters by sqrt(2 / n) of their variance.
        least = max(LEAST_DRIFT, GAIN_DEVIATIONS * np.sqrt(2 / found.size)) * error
        return _share_above_chance(found, variances, true if true > least else 0.0, arcs)

    slope = share("slope")
    # A constant offset alone is no drift: data.rings removes it.
    return LightDrift(np.where(slope > 0, share("offset"), 0) * drift.offset, slope * drift.slope)


def _find_offsets(y: np.ndarray, width: int) -> np.ndarray:
    """The offsets (cols,) of constant gains in a row (views, cols)."""
    ranked, columns = np.sort(y, axis=0), y.shape[1]
    steps = np.median(ranked - median_filter(ranked, (1, width // 4 | 1), mode="nearest"), axis=0)
    # One number a column changes no rank.
    bend = np.median(np.diff(ranked - steps, 2, axis=1), axis=0)
    # A normal deviate has a median size of 1 / 1.4826.
    is_smooth = np.abs(bend) <= EDGE_BEND * 1.4826 * np.median(np.abs(bend))
    second = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(columns - 2, columns)).tocsr()[is_smooth]
    normal = eye_array(columns) + (width / (2 * np.pi)) ** 4 * second.T @ second
    return steps + spsolve(normal.tocsc(), (width / (2 * np.pi)) ** 4 * (second.T @ bend[is_smooth]))


def find_zingers(transmission: Transmission, threshold: float) -> np.ndarray:
    """Find pixels hit by cosmic rays and hot pixels: (views, rows, cols) bool.

    A pixel is compared with the median of the 3 x 3 pixels around it, and with the median of the same pixel in the views
    before and after: it must differ from both medians by ``threshold`` deviations, the same way. The deviation of a
    difference is that of the noise, and at least the robust deviation of all differences in the view, or of the pixel's bends
    over time: details of the object pass by. They are near the pixel in the views before and after: a zinger also lies outside
    of the range of the 3 x 5 pixels around it in one of these views.

    Args:
        transmission: (views, rows, cols) with its variance.
        threshold: deviations above which a pixel is not used.
    """
    value = transmission.value
    seen = np.isfinite(value)
    filled = interpolate_gaps(np.where(seen, value, 0.0), seen)
    noise = np.sqrt(np.where(seen, np.maximum(transmission.variance, 0.0), 0.0))
    size = (1, 3 if value.shape[1] >= 3 else 1, 3)
    shape = (3, 1, 1) if len(value) >= 3 else (1, 1, 1)
    # A hot pixel is hot in all views: the neighbours in the view alone tell.
    around, before = filled - median_filter(filled, size), filled - median_filter(filled, shape)
    scale = 1.4826 * np.median(np.abs(around), axis=(1, 2), keepdims=True)
    far = around / np.maximum(np.maximum(noise, scale), 1e-12)
    bends = 1.4826 * np.median(np.abs(np.diff(filled, 2, axis=0)), axis=0) / 2 if len(value) >= 3 else 0.0
    near = before / np.maximum(np.maximum(noise, bends), 1e-12)
    hot = np.mean(np.abs(far) > threshold, axis=0) > HOT_SHARE
    jumps = (np.abs(far) > threshold) & (np.abs(near) > threshold) & (far * near > 0)
    return seen & (hot | jumps & ~_passes_by(filled - np.where(hot, around, 0.0)))


def _passes_by(value: np.ndarray) -> np.ndarray:
    """Whether pixels (views, rows, cols) lie in the range of the pixels around them, in both neighbouring views."""
    size, is_inside = (1, *NEAR), np.ones(value.shape, bool)
    highest, lowest = maximum_filter(value, size, mode="nearest"), minimum_filter(value, size, mode="nearest")
    for here, other in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
        is_inside[here] &= (value[here] <= highest[other]) & (value[here] >= lowest[other])
    return is_inside & (len(value) > 1)


NEAR = (3, 5)
"""Rows and columns in which a detail is looked for in the views before and after: it moves along the rows, mostly."""


HOT_SHARE = 0.75
"""Share of the views in which a hot pixel differs from its neighbours: a detail of the object moves on."""


class PixelGains:
    r"""Constant gains g of the pixels as unknowns of a weighted least-squares problem, which eliminates them.

    The offsets :math:`o = -\log g` minimise, for the residual r of a volume and with T the sum of a pixel's weights,

    .. math:: \sum_v w_v (r_v - o)^2 + \bar T \, o^T K^{-1} o, \qquad K = (p / 2 \pi)^4 D^T D

    row by row, with second differences D along the detector and the median :math:`\bar T` of T. So offsets that vary slowly
    are dear: half of one with the period p is found, less of a longer one, and no straight line. What is left is
    quadratic in r: ``r . weigh(r)``, with the derivative ``2 weigh(r)`` (variable projection).

    Bias: a detail that all views see at the same column, such as a tube about the axis, can count as gains, and total variation
    prefers it flat. This bias is smooth along the detector, which p limits.

    Args:
        weights: inverse variances (views, rows, cols); a pixel of weight 0 in all views gets no offset.
        period: p [column].

    References: Golub & Pereyra 1973, SIAM J. Numer. Anal. 10, 413 (variable projection); Eilers 2003, Anal. Chem. 75, 3631
    (penalised second differences).
    """

    def __init__(self, weights: np.ndarray, period: float = GAIN_PERIOD) -> None:
        self._weights = weights
        self._total, columns = weights.sum(0, dtype=np.float64), weights.shape[2]
        second = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(max(columns - 2, 0), columns)).tocsr()
        self._stiffness = ((period / (2 * np.pi)) ** 4 * second.T @ second).tocsr()
        middle = np.median(self._total[self._total > 0]) if self._total.any() else 1.0
        # With o = K q, the minimum has (T K + middle) q = T m, with the weighted mean m of the residual.
        self._solvers = [splu((diags_array(t) @ self._stiffness + middle * eye_array(columns)).tocsc()) for t in self._total]

    def fit(self, residual: np.ndarray) -> np.ndarray:
        """The offsets (rows, cols) for a residual (views, rows, cols)."""
        sums = (self._weights * residual).sum(0, dtype=np.float64)
        found = np.stack([self._stiffness @ solver.solve(row) for solver, row in zip(self._solvers, sums, strict=True)])
        return np.where(self._total > 0, found, 0.0)

    def weigh(self, residual: np.ndarray) -> np.ndarray:
        """The weighted residual without its offsets, in the shape of ``residual``."""
        seen = residual.reshape(self._weights.shape)
        left = seen - self.fit(seen).astype(residual.dtype)
        left *= self._weights
        return left.reshape(residual.shape)


def _smooth_striped(y: np.ndarray, width: int) -> np.ndarray:
    """``_smooth_ranks`` of a row (views, cols) in which gains are found; other rows are returned unchanged."""
    is_striped = not np.array_equal(_subtract_gains(y, min(RING_WIDTHS["gain"], y.shape[1])), y)
    return _smooth_ranks(y, width) if is_striped else y


def _smooth_ranks(y: np.ndarray, width: int) -> np.ndarray:
    """A row (views, cols) whose sorted values are the median over columns."""
    order, smooth = np.argsort(y, axis=0, kind="stable"), np.empty(y.shape)
    ranked = median_filter(np.take_along_axis(y, order, 0), (1, width), mode="nearest")
    np.put_along_axis(smooth, order, ranked, 0)
    return smooth
