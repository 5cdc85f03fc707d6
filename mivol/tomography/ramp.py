"""The ramp filter of filtered back-projection, and the windows that trade its noise for resolution.

References: Kak & Slaney, Principles of Computerized Tomographic Imaging (1988), section 3.3, Eq. 61 (the band-limited ramp);
Ramachandran & Lakshminarayanan 1971 (no window); Shepp & Logan 1974 (the sinc window).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.fft

from mivol.errors import MivolError

#: What a frequency keeps, by the window's name; ``f`` is the frequency over the cutoff, 0 to 1.
WINDOWS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "ram-lak": np.ones_like,
    "shepp-logan": lambda f: np.sinc(f / 2),
    "cosine": lambda f: np.cos(np.pi * f / 2),
    "hamming": lambda f: 0.54 + 0.46 * np.cos(np.pi * f),
    "hann": lambda f: 0.5 + 0.5 * np.cos(np.pi * f),
}


def filter_ramp(y: np.ndarray, pitch: float, window: str = "ram-lak", cutoff: float = 1.0) -> np.ndarray:
    """Convolve each row with the band-limited ramp, zero beyond the detector.

    ``h(0) = 1 / (4 pitch^2)``, ``h(n) = -1 / (pi n pitch)^2`` for odd n, 0 for even n; the sum is multiplied by ``pitch``. The
    kernel is sampled in space, so its mean is right; a ramp sampled in frequency would shift all values of the object.

    Args:
        y: (..., cols).
        pitch: pitch of the columns [length].
        window: key of WINDOWS.
        cutoff: end of the window over the Nyquist frequency, in (0, 1].

    Returns:
        (..., cols) float64 [1/length].

    Raises:
        MivolError: an unknown window, or a cutoff outside (0, 1].
    """
    if window not in WINDOWS:
        raise MivolError(f'found the filter window "{window}", expected one of {", ".join(WINDOWS)}.')
    if not 0 < cutoff <= 1:
        raise MivolError(f"found a cutoff of {cutoff}, expected a part of the Nyquist frequency above 0, at most 1.")
    n = y.shape[-1]
    size = scipy.fft.next_fast_len(2 * n, real=True)
    k = np.minimum(np.arange(size), size - np.arange(size))
    h = np.where(k % 2 == 1, -1.0 / (np.pi * np.maximum(k, 1) * pitch) ** 2, 0.0)
    h[0] = 1.0 / (4 * pitch**2)
    f = 2 * scipy.fft.rfftfreq(size) / cutoff
    kept = np.where(f <= 1, WINDOWS[window](np.minimum(f, 1.0)), 0.0)
    return pitch * scipy.fft.irfft(scipy.fft.rfft(y, size) * (scipy.fft.rfft(h).real * kept), size)[..., :n]
