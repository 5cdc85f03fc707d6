"""Reference images on disk, with a checkpoint of their batches, and the comparison of an image with its reference.

Conventions. A reference is an OpenEXR file, float32: channels R, G, B and variance.R, .G, .B (Y and variance.Y in mono
variants). Its header holds the identity of the image (the scene's content hash) and the method. The file ``<name>.state.npz``
beside the image holds the moments of all batches in float64. So an interrupted reference continues unchanged, and a later call
can reach a higher accuracy.

Comparison. An image is compared with its reference in units of the expected noise. Batches give the variance of the
reference; the variance of the image is given (0: exact). Half of ``alpha``, the chance of a false alarm, goes to the largest
difference of all pixels, half to the mean difference, as in :mod:`mivol.validate.statistics`. PSNR cannot tell noise from
error; PSNR is reported but never decides.
"""

from __future__ import annotations

import hashlib
import json
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter

import mivol
from mivol.display import with_short_repr
from mivol.errors import MivolError, MivolWarning
from mivol.files.atomic import write_whole
from mivol.files.image_files import read_exr, write_exr
from mivol.files.npy import read_archive
from mivol.validate.metrics import nrmse, psnr
from mivol.validate.statistics import (
    Bias,
    Estimate,
    Moments,
    Significance,
    estimate_bias,
    smallest_detectable_bias,
    z_bound,
    z_image,
)
from mivol.validate.trust import Doubt


@with_short_repr
@dataclass(frozen=True)
class ReferenceResult:
    """A reference image.

    Attributes:
        mean: (H, W, C) radiance.
        variance: (H, W, C) of the mean.
        batches: independent batches behind both.
        spp: samples behind each pixel and channel.
        identity: scene and method; equal for references that may be averaged.
        path: the file.
        doubts: reasons not to trust the reference.
        seconds: rendering time of all sessions together.
        reached: whether the requested accuracy was reached; False if ``max_spp`` came first.
    """

    mean: np.ndarray
    variance: np.ndarray
    batches: int
    spp: int
    identity: dict[str, object]
    path: Path
    doubts: tuple[Doubt, ...] = ()
    seconds: float = 0.0
    reached: bool = True

    @property
    def standard_error(self) -> float:
        """Root mean square over pixels and channels of the standard error of the mean [radiance]."""
        return float(np.sqrt(self.variance.mean()))

    def variance_with_unseen(self, brightest: float) -> np.ndarray:
        """Variance of the mean, with an allowance for light that the samples of a pixel hit too seldom, or never.

        If no path of a pixel hits a faint light, the estimated variance is 0; if few paths do, variance and mean are both too
        small. Neighbouring pixels hit the same light independently. So the variance is at least the mean over 3 x 3 pixels,
        and at least the variance of a single bright sample, (brightest / spp)^2.

        Args:
            brightest: largest value of a sample [radiance].

        Returns:
            (H, W, C) [radiance^2].
        """
        around = uniform_filter(np.asarray(self.variance, dtype=np.float64), size=(3, 3, 1), mode="nearest")
        return np.maximum(np.maximum(self.variance, around), (brightest / self.spp) ** 2)

    @property
    def relative_error(self) -> float:
        """``standard_error`` divided by the mean absolute radiance of the image."""
        return relative_error(self.standard_error, self.mean)

    @property
    def text(self) -> str:
        """A paragraph."""
        how = self.identity
        missed = "" if self.reached else ", above the target"
        one = "each channel alone" if how["channels_alone"] else "all channels at once"
        doubts = "".join(f" Doubt: {d.sentence}" for d in self.doubts)
        return (
            f"{self.path.name}: {self.mean.shape[1]}x{self.mean.shape[0]} by {how['integrator']} "
            f"(max_depth {how['max_depth']}, {one}), {self.spp} samples a pixel in {self.batches} batches, "
            f"standard error {self.standard_error:.3g} "
            f"({100 * self.relative_error:.2g} % of the mean{missed}), {self.seconds:.0f} s.{doubts}"
        )


def relative_error(error: float, mean: np.ndarray) -> float:
    """An error over the mean absolute radiance of an image; infinite for a black image with an error."""
    level = float(np.abs(mean).mean())
    return error / level if level > 0 else (0.0 if error == 0 else float("inf"))


def read_reference(path: str | Path, content_hash: str | None = None) -> ReferenceResult:
    """Read a reference from its file.

    Args:
        path: the EXR file.
        content_hash: expected content hash of the scene; None: not checked.

    Raises:
        MivolError: a file that is not a reference, a damaged reference, or the reference of another scene.
    """
    channels, header = read_exr(path)
    if "mivol_reference" not in header:
        raise MivolError(f"{path} is an image but not a reference of mivol's; make one with mivol reference.")
    try:
        found = _from_channels(Path(path), channels, json.loads(header["mivol_reference"]))
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise MivolError(f"{path} is a damaged reference; delete it, and make it with mivol reference.") from error
    if content_hash is not None and found.identity["scene"] != content_hash:
        raise MivolError(_describe_difference(Path(path), "scene", found.identity["scene"], content_hash))
    return found


def _parse_identity(made: dict[str, Any]) -> dict[str, Any]:
    """Scene and method of an image.

    Raises:
        KeyError: no scene, or no samples per pass.
    """
    identity = dict(made["identity"])
    return identity | {"scene": str(identity["scene"]), "pass_spp": int(identity["pass_spp"])}


def _from_channels(path: Path, channels: dict[str, np.ndarray], made: dict[str, Any]) -> ReferenceResult:
    """Make a reference from the channels and the header of its file."""
    names = [name for name in ("R", "G", "B", "Y") if name in channels]
    return ReferenceResult(
        mean=np.stack([channels[n] for n in names], axis=-1).astype(np.float64),
        variance=np.stack([channels[f"variance.{n}"] for n in names], axis=-1).astype(np.float64),
        batches=int(made["batches"]),
        spp=int(made["spp"]),
        identity=_parse_identity(made),
        path=path,
        doubts=tuple(Doubt(**d) for d in made["doubts"]),
        seconds=float(made["seconds"]),
    )


def reference_path(out: Path, name: str, identity: dict[str, Any]) -> Path:
    """The file of a reference: ``out`` itself, or a file in the folder ``out`` named after the scene and the identity.

    Raises:
        MivolError: another suffix than .exr.
    """
    if out.suffix.lower() == ".exr":
        return out
    if out.suffix or (out.exists() and not out.is_dir()):
        raise MivolError(f"a reference is an OpenEXR file, not {out.name}; give a name that ends in .exr, or a folder.")
    out.mkdir(parents=True, exist_ok=True)
    how = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()
    return out / f"{name}-{identity['scene'][:12]}-{how[:8]}.exr"


def checkpoint_path(path: Path) -> Path:
    """The file of the batches."""
    return path.with_suffix(".state.npz")


def check_identity(path: Path, found: dict[str, Any], wanted: dict[str, Any]) -> None:
    """Refuse a file of another scene or another method.

    Raises:
        MivolError: the first differing key.
    """
    for key, value in wanted.items():
        if found.get(key) != value:
            raise MivolError(_describe_difference(path, key, found.get(key), value))


def _describe_difference(path: Path, key: str, found: Any, wanted: Any) -> str:
    if key == "scene":
        return (
            f"{path} is the reference of another scene (content {str(found)[:12]}, not {str(wanted)[:12]}); choose another "
            "file, or delete it."
        )
    return f"{path} was made with {key} = {found}, not {wanted}; choose another file, or delete it."


def write_checkpoint(path: Path, identity: dict[str, Any], moments: Moments, seconds: float) -> None:
    """Write the batches beside a reference."""
    text = json.dumps({"identity": identity, "seconds": seconds})
    m = moments
    write_whole(checkpoint_path(path), lambda file: np.savez(file, n=m.n, mean=m.mean, m2=m.m2, made=np.array(text)))


def read_checkpoint(state: Path) -> tuple[dict[str, Any], Moments]:
    """Read the batches of a checkpoint, with ``identity`` and ``seconds``.

    Raises:
        MivolError: an incomplete checkpoint.
    """
    try:
        stored = read_archive(state)
        made = json.loads(str(stored["made"]))
        found = {"identity": _parse_identity(made), "seconds": float(made["seconds"])}
        return found, Moments(int(stored["n"]), stored["mean"], stored["m2"])
    except (MivolError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise MivolError(f"{state} is not a whole checkpoint of a reference; delete it to start over.") from error


def write_reference(result: ReferenceResult) -> None:
    """Write the image, its variance and its header to ``result.path``."""
    names = "RGB" if result.mean.shape[-1] == 3 else "Y"
    channels = {name: result.mean[..., i] for i, name in enumerate(names)}
    channels |= {f"variance.{name}": result.variance[..., i] for i, name in enumerate(names)}
    made = {
        "identity": result.identity,
        "batches": result.batches,
        "spp": result.spp,
        "seconds": result.seconds,
        "doubts": [vars(d) for d in result.doubts],
        "mivol": mivol.__version__,
    }
    write_exr(result.path, channels, {"mivol_reference": json.dumps(made)})


@with_short_repr
@dataclass(frozen=True)
class Comparison:
    """The comparison of an image with its reference.

    Attributes:
        z: (H, W, C) difference in standard errors.
        bound: bound on |z|; if the means agree, the largest |z| of all values exceeds the bound with chance ``alpha``/2.
        beyond: share of values with |z| above the bound; 0 expected.
        above_three: share of values with |z| > 3; 0.0027 expected of normal noise.
        worst: (row, column, channel) of the largest |z|.
        bias: mean difference with its confidence interval.
        detectable: median over pixels of the smallest bias found 9 times in 10 [radiance].
        psnr: [dB], peak of the reference; -inf for a black reference.
        nrmse: norm of the difference over the norm of the reference; inf for a black reference.
        alpha: chance of a false alarm.
    """

    z: np.ndarray
    bound: float
    beyond: float
    above_three: float
    worst: tuple[int, int, int]
    bias: Bias
    detectable: float
    psnr: float
    nrmse: float
    alpha: float

    @property
    def agrees(self) -> bool:
        """Whether no pixel exceeds the bound, and the interval of the bias contains 0."""
        return self.beyond == 0 and self.bias.low <= 0 <= self.bias.high

    @property
    def text(self) -> str:
        """A paragraph."""
        verdict = "agrees with the reference" if self.agrees else "differs from the reference"
        return (
            f"The image {verdict}: {100 * self.beyond:.2g} % of its values lie beyond {self.bound:.1f} standard errors (alpha "
            f"{self.alpha:g} for the whole image), {100 * self.above_three:.2g} % beyond 3 (0.27 % expected), the worst "
            f"{self.z[self.worst]:+.1f} at row {self.worst[0]}, column {self.worst[1]}, channel {self.worst[2]}. The mean "
            f"difference is {self.bias.value:+.2g}, between {self.bias.low:+.2g} and {self.bias.high:+.2g}; in one pixel "
            f"{self.detectable:.2g} would be found 9 times in 10. PSNR {self.psnr:.1f} dB, nRMSE {self.nrmse:.2g}."
        )


def compare(
    image: Estimate,
    reference: ReferenceResult,
    *,
    alpha: float = 1e-3,
    samples_seen: float = 0.0,
    rounding: float = 0.0,
    correlated: int = 3,
) -> Comparison:
    """Compare an image with a reference.

    Args:
        image: (H, W, C), with the variance of its own mean; 0 for an exact image.
        reference: result of ``render_reference`` or ``read_reference`` (which refuses the reference of another scene).
        alpha: chance that images of equal mean are reported as different.
        samples_seen: largest value of a single sample [radiance], for instance the background's. The variance then allows for
            light missed by the samples, see :meth:`ReferenceResult.variance_with_unseen`. 0: the variance as estimated.
        rounding: as in :func:`mivol.validate.statistics.z_image`.
        correlated: as in :func:`mivol.validate.statistics.estimate_bias`; 3: the channels share their paths, with a box
            filter.

    Raises:
        MivolError: an image of another size, or values that are not finite.
    """
    mean = np.asarray(image.mean, dtype=np.float64)
    if mean.shape != reference.mean.shape:
        raise MivolError(f"an image of shape {mean.shape} cannot be compared with a reference of {reference.mean.shape}.")
    var = reference.variance_with_unseen(samples_seen) if samples_seen else reference.variance
    truth, dof = Estimate(reference.mean, var, reference.batches - 1), reference.batches - 1
    difference = estimate_bias(image, truth, alpha=alpha / 2, correlated=correlated)
    dark = not reference.mean.any()
    z, level = z_image(image, truth, rounding), Significance(alpha / 2, mean.size)
    bound = float(z_bound(level, dof))
    return Comparison(
        z=z,
        bound=bound,
        beyond=float(np.mean(np.abs(z) > bound)),
        above_three=float(np.mean(np.abs(z) > 3)),
        worst=tuple(int(i) for i in np.unravel_index(np.argmax(np.abs(z)), z.shape)),
        bias=difference,
        detectable=float(np.median(smallest_detectable_bias(image.var + var, level=level, dof=dof))),
        psnr=-np.inf if dark else psnr(mean, reference.mean),
        nrmse=np.inf if dark else nrmse(mean, reference.mean),
        alpha=alpha,
    )


def drop_damaged(path: Path) -> None:
    """Remove damaged files from a folder whose files mivol names, with a warning."""
    for file, read in ((path, read_reference), (checkpoint_path(path), read_checkpoint)):
        try:
            if file.exists():
                read(file)
        except MivolError as error:
            warnings.warn(f"{file.name} is damaged and made anew: {error}", MivolWarning, stacklevel=4)
            file.unlink()


def find_pass_spp(path: Path) -> int | None:
    """Samples per pass of a stored reference, for continuing to a higher accuracy."""
    state = checkpoint_path(path)
    if state.exists():
        return int(read_checkpoint(state)[0]["identity"]["pass_spp"])
    return int(read_reference(path).identity["pass_spp"]) if path.exists() else None
