"""The pictures of a run's page: views with their differences, slices of volumes, films; those of one kind share one scale.

Conventions. Pictures are ``data:`` addresses, so that the page loads nothing from anywhere.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.image import imread
from numpy.typing import NDArray

from mivol.errors import MivolError
from mivol.files import read_exr, read_volume, stack_layers
from mivol.report import pixel_scale
from mivol.report.record import LINES, Image, Volume

__all__ = [
    *("ColourBar", "PageImage", "ViewRow", "ViewRows", "VolumeView"),
    *("encode_film", "encode_image", "make_view_rows", "make_volume_views"),
]

LAYERS = 16
LAYER_EDGE = 128
"""Slices of a volume that a page can be scrolled through, and pixels of an edge: a page stays below a few MB."""

WIDEST = 8.0
"""Longer over shorter edge of a picture: two rows of a detector would be a line otherwise. Longer ones are stretched to it."""

Z_LIMIT = 4.0
Z_ODD = 3.0
FILMS = {".mp4": "video/mp4", ".webp": "image/webp", ".gif": "image/gif"}


class PageImage(NamedTuple):
    """One picture of the page: a PNG as an address, its size in pixels and its width over height in the world."""

    name: str
    uri: str
    width: int
    height: int
    aspect: float

    @property
    def is_coarse(self) -> bool:
        """True where pixels are to be seen as squares when the picture is enlarged."""
        return max(self.width, self.height) <= 320


class ViewRow(NamedTuple):
    """A row of pictures of one view with its numbers."""

    name: str
    held_out: bool
    pictures: list[PageImage]
    psnr: float | None
    text: str
    small: bool = False


class ColourBar(NamedTuple):
    """A colour bar: what it measures, its ends, and its CSS gradient."""

    label: str
    low: str
    high: str
    gradient: str


class ViewRows(NamedTuple):
    """Views that share scales."""

    rows: list[ViewRow]
    bars: list[ColourBar]


class VolumeView(NamedTuple):
    """Slices of one quantity's volumes, one row a plane, and the voxels of the reconstruction along x, y, z; and slices xy from
    the lowest to the highest, to be scrolled through, one row a layer (none of a volume of one layer)."""

    title: str
    shape: tuple[int, ...]
    rows: list[dict[str, Any]]
    bars: list[ColourBar]
    layers: list[dict[str, Any]]


def make_view_rows(folder: Path, images: Sequence[Image]) -> ViewRows:
    """Views that have a reference or a render, held-out ones first, all on the same scales."""
    by_view: dict[str, dict[str, Image]] = {}
    for image in images:
        if image.role not in ("slice", "picture", "film"):
            by_view.setdefault(image.view or image.path, {})[image.role] = image
    arrays = {name: {role: _load(folder, image) for role, image in roles.items()} for name, roles in by_view.items()}
    for name, roles in arrays.items():
        _check_sizes(name, roles)
        _add_differences(roles)
    scales = _scales(arrays.values())
    rows = [_view(name, by_view[name], roles, scales) for name, roles in arrays.items()]
    rows.sort(key=lambda view: not view.held_out)
    first = next((image for roles in by_view.values() for image in roles.values()), None)
    return ViewRows(rows, [_bar(scales[role], label) for role, label in _bar_labels(scales, first)])


def _load(folder: Path, image: Image) -> NDArray:
    """Pixels of an image: float64 linear values, or uint8 of a PNG that is shown as it is."""
    path = folder / image.path
    if path.suffix == ".png":
        return _png(path)
    if path.suffix == ".npy":
        return np.load(path, allow_pickle=False).astype(float)
    return _exr(path, image.layer)


def _exr(path: Path, layer: str) -> NDArray:
    stacked = stack_layers(read_exr(path)[0])
    wanted = [layer] if layer else ["", "Y", *(stacked if len(stacked) == 1 else ())]
    name = next((name for name in wanted if name in stacked), None)
    if name is None:
        listed = ", ".join(f'"{name}"' for name in stacked)
        raise MivolError(f"{path.name} has the layers {listed}; name one of them in the record.")
    return stacked[name].astype(float).reshape(*stacked[name].shape[:2], -1)[..., :3]


def _png(path: Path) -> NDArray[np.uint8]:
    try:
        pixels = imread(path, format="png")
    except (OSError, SyntaxError, ValueError) as error:
        raise MivolError(f"{path.name} is no whole PNG ({error}); restore it, or make the run again.") from error
    rgb = np.repeat(pixels[..., None], 3, axis=2) if pixels.ndim == 2 else pixels[..., :3]
    return np.round(255 * rgb).astype(np.uint8)


def _check_sizes(view: str, roles: dict[str, NDArray]) -> None:
    sizes = {role: image.shape[:2] for role, image in roles.items()}
    if len(set(sizes.values())) > 1:
        listed = ", ".join(f"{role} {height} x {width}" for role, (height, width) in sizes.items())
        raise MivolError(f'images of view "{view}" differ in size ({listed}); render them at one size.')


def _add_differences(roles: dict[str, NDArray]) -> None:
    """Put the difference and the z-image beside a reference and a render of linear values, an error beside those of pixels."""
    if {"reference", "render"} <= roles.keys() and roles["reference"].dtype == roles["render"].dtype == np.uint8:
        roles["error"] = np.abs(roles["render"].astype(float) - roles["reference"]).mean(axis=2) / 255
    if not _are_numbers(roles, "reference", "render"):
        return
    difference = roles["difference"] = roles["render"] - roles["reference"]
    if _are_numbers(roles, "standard error"):
        with np.errstate(divide="ignore", invalid="ignore"):
            roles["z"] = np.where(difference == 0, 0.0, difference / roles["standard error"])


def _are_numbers(roles: dict[str, NDArray], *names: str) -> bool:
    """True where all of these are there and hold linear values, not the bytes of a PNG."""
    return all(name in roles and roles[name].dtype != np.uint8 for name in names)


def _scales(views: Iterable[dict[str, NDArray]]) -> dict[str, pixel_scale.Scale]:
    """Scales by role, each shared by all views: values from the references, differences symmetric, z fixed."""
    views = [{role: image for role, image in roles.items() if _are_numbers(roles, role)} for roles in views]
    shown = [roles.get("reference", roles.get("render")) for roles in views]
    values = [image for image in shown if image is not None]
    differences = [roles["difference"] for roles in views if "difference" in roles]
    scales = {}
    if values:
        scales["reference"] = scales["render"] = pixel_scale.shared_scale(*values)
    if differences:
        scales["difference"] = pixel_scale.signed_scale(*differences)
    errors = [roles["error"] for roles in views if "error" in roles]
    if errors:
        scales["error"] = pixel_scale.shared_scale(*errors)
    if any("z" in roles for roles in views):
        scales["z"] = pixel_scale.Scale("signed", -Z_LIMIT, Z_LIMIT)
    return scales


PANELS = {
    "reference": "Reference",
    "render": "Render",
    "difference": "Render − reference",
    "error": "|Render − reference|",
    "z": "z-image",
}
PANELS_OF_LINES = {
    "reference": "Measured",
    "render": "Modelled",
    "difference": "Modelled − measured",
    "z": "Difference over noise",
}


def _names_of(images: Iterable[Image]) -> dict[str, str]:
    """What the pictures of a view are called: a line integral is measured, not rendered."""
    return PANELS_OF_LINES if any(image.quantity == LINES for image in images) else PANELS


def _view(name: str, images: dict[str, Image], roles: dict[str, NDArray], scales: dict[str, pixel_scale.Scale]) -> ViewRow:
    names = _names_of(images.values())
    pictures = [_picture(names[role], roles[role], scales.get(role)) for role in names if role in roles]
    words = [next((image.caption for image in images.values() if image.caption), "")]
    psnr = None
    if _are_numbers(roles, "reference", "difference"):
        psnr, said = _agreement(roles["reference"], roles["difference"])
        words.append(said)
    if "z" in roles:
        words.append(f"|z| > {Z_ODD:g} in {np.mean(np.abs(roles['z']) > Z_ODD):.1%} of the values")
    held_out = any(image.held_out for image in images.values())
    small = any(image.small for image in images.values())
    return ViewRow(name, held_out, pictures, psnr, " · ".join(word for word in words if word), small)


def _agreement(reference: NDArray, difference: NDArray) -> tuple[float | None, str]:
    """PSNR [dB] with the reference's largest value as the peak, where it is a number, and what to say of the view."""
    broken = int(np.sum(~np.isfinite(difference)))
    if broken:
        return None, f"{broken} of {difference.size} values not finite"
    mse, power, peak = (float(f(v)) for f, v in ((np.mean, difference**2), (np.mean, reference**2), (np.max, reference)))
    if mse == 0 or peak <= 0:
        return None, "identical" if mse == 0 else f"RMSE {np.sqrt(mse):.3g}"
    psnr = 10 * np.log10(peak**2 / mse)
    return psnr, f"PSNR {psnr:.1f} dB · nRMSE {np.sqrt(mse / power):.3g}"


def _picture(name: str, image: NDArray, scale: pixel_scale.Scale | None, aspect: float | None = None) -> PageImage:
    rgb = image if image.dtype == np.uint8 else pixel_scale.to_pixels(image, scale or pixel_scale.shared_scale(image))
    height, width = rgb.shape[:2]
    true = aspect or width / height
    shown = min(max(true, 1 / WIDEST), WIDEST)
    return PageImage(name if shown == true else f"{name}, stretched", pixel_scale.data_uri(rgb), width, height, shown)


def encode_image(folder: Path, image: Image) -> PageImage:
    """An image that stands alone, with a scale of its own."""
    return _picture(image.caption or image.view or Path(image.path).stem, _load(folder, image), None)


def encode_film(folder: Path, image: Image) -> tuple[str, str, bool]:
    """The caption of a film, the film as an address, and whether it is an animated image."""
    coded = base64.b64encode((folder / image.path).read_bytes()).decode()
    kind = FILMS[Path(image.path).suffix]
    return image.caption or image.view, f"data:{kind};base64,{coded}", kind.startswith("image/")


def _bar_labels(scales: dict[str, pixel_scale.Scale], image: Image | None) -> list[tuple[str, str]]:
    what = f"{image.quantity} [{image.unit}]" if image and image.unit else image.quantity if image else ""
    names = _names_of([image] if image else [])
    labels = {
        "reference": f"{what[:1].upper()}{what[1:]}",
        "difference": names["difference"],
        "error": "|Render − reference|, mean of the colours [code value]",
        "z": names["z"] if names is PANELS_OF_LINES else "z = difference / standard error",
    }
    return [(role, label) for role, label in labels.items() if role in scales]


def _bar(scale: pixel_scale.Scale, label: str) -> ColourBar:
    stops = pixel_scale.to_pixels(np.linspace(scale.low, scale.high, 17)[None, :], scale)[0]
    gradient = ", ".join("#{:02x}{:02x}{:02x}".format(*stop) for stop in stops)
    # A percentile between zeros may be 1e-16.
    low = scale.low if abs(scale.low) > 1e-9 * scale.high else 0.0
    return ColourBar(label, f"{low:.3g}", f"{scale.high:.3g}", gradient)


# -- Volume -------------------------------------------------------------------------------------------------------------


def make_volume_views(folder: Path, volumes: Sequence[Volume]) -> list[VolumeView]:
    """Slices of every volume that was reconstructed: those of one caption and quantity belong together."""
    groups: dict[tuple[str, str], dict[str, Volume]] = {}
    for volume in volumes:
        groups.setdefault((volume.caption, volume.quantity), {})[volume.role] = volume
    return [_cut(folder, group) for group in groups.values() if "reconstruction" in group]


def _cut(folder: Path, by_role: dict[str, Volume]) -> VolumeView:
    """Slices of the truth, the reconstruction and their difference, one row a plane."""
    data = {role: read_volume(folder / by_role[role].path) for role in ("truth", "reconstruction") if role in by_role}
    size = by_role["reconstruction"].size or tuple(np.linalg.norm(data["reconstruction"].to_world[:3, :3], axis=0))
    cuts = {role: pixel_scale.middle_slices(found.values, size) for role, found in data.items()}
    if len(cuts) == 2 and data["truth"].values.shape == data["reconstruction"].values.shape:
        truth, found = cuts["truth"].images, cuts["reconstruction"]
        cuts["difference"] = found._replace(images={p: image - truth[p] for p, image in found.images.items()})
    first = next(iter(cuts.values()))
    values = pixel_scale.shared_scale(*first.images.values())
    scales = {"truth": values, "reconstruction": values}
    if "difference" in cuts:
        scales["difference"] = pixel_scale.signed_scale(*cuts["difference"].images.values())
    rows = [_plane(plane, cuts, scales) for plane in first.images] if len(cuts) > 1 else [_planes(first, values)]
    described = by_role["reconstruction"]
    unit = f" [{described.unit}]" if described.unit else ""
    bars = [_bar(values, f"{described.quantity}{unit}")]
    if "difference" in scales:
        bars.append(_bar(scales["difference"], f"Reconstruction − truth{unit}"))
    found = data["reconstruction"].values
    volumes = {role: each.values for role, each in data.items()}
    if "difference" in cuts:
        volumes["difference"] = found - volumes["truth"]
    layers = [_layer(share, volumes, scales, first.aspect["xy"]) for share in _heights(found.shape[0])]
    return VolumeView(described.caption or described.quantity, found.shape[2::-1], rows, bars, layers)


def _heights(count: int) -> list[float]:
    """Where the layers of a volume are that can be scrolled through: at most LAYERS, as shares of its height."""
    return [] if count < 2 else ((np.arange(min(count, LAYERS)) + 0.5) / min(count, LAYERS)).tolist()


def _layer(share: float, volumes: dict[str, NDArray], scales: dict[str, pixel_scale.Scale], aspect: float) -> dict[str, Any]:
    """The slice xy at a share of the height of each volume, the second axis upwards, at most LAYER_EDGE pixels an edge."""
    count = volumes["reconstruction"].shape[0]
    pictures = []
    for role, values in volumes.items():
        step = max(1, -(-max(values.shape[1:3]) // LAYER_EDGE))
        image = values[int(share * values.shape[0]), ::-step, ::step]
        pictures.append(_picture(role.capitalize(), image, scales[role], aspect))
    return {"name": "xy", "text": f"z = {int(share * count) + 1} of {count}", "pictures": pictures}


def _planes(cut: pixel_scale.Slices, scale: pixel_scale.Scale) -> dict[str, Any]:
    """The three planes of one volume side by side."""
    pictures = [_picture(f"{p}, {cut.where[p]}", image, scale, cut.aspect[p]) for p, image in cut.images.items()]
    return {"plane": "", "where": "", "pictures": pictures}


def _plane(plane: str, cuts: dict[str, pixel_scale.Slices], scales: dict[str, pixel_scale.Scale]) -> dict[str, Any]:
    pictures = [_picture(role.capitalize(), cut.images[plane], scales[role], cut.aspect[plane]) for role, cut in cuts.items()]
    return {"plane": plane, "where": cuts["reconstruction"].where[plane], "pictures": pictures}
