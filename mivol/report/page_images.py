"""The images of a report page: views with their differences, slices of volumes, films.

Conventions. Images are ``data:`` addresses, so the page loads nothing. All images of a kind share one scale.
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

LAYERS = 16
LAYER_EDGE = 128
"""Largest number of scrollable slices of a volume, and their largest edge [pixel]: a page stays below a few MB."""

WIDEST = 8.0
"""Largest ratio of the edges of an image. The page stretches longer images, which keeps two detector rows visible."""

Z_IMAGE = "z-image"
"""Name of the image of differences divided by their standard errors."""

Z_LIMIT = 4.0
"""Ends of the scale of a z-image."""

Z_OUTLIER = 3.0
"""Larger values of a z-image are counted in the text of the view."""

FILMS = {".mp4": "video/mp4", ".webp": "image/webp", ".gif": "image/gif"}


class PageImage(NamedTuple):
    """One image of the page: a PNG as ``data:`` address, its size [pixel], and its width over height in the world."""

    name: str
    uri: str
    width: int
    height: int
    aspect: float

    @property
    def is_coarse(self) -> bool:
        """Whether an enlarged image shows its pixels as squares."""
        return max(self.width, self.height) <= 320


class ViewRow(NamedTuple):
    """The images of a view in a row, with their numbers."""

    name: str
    held_out: bool
    pictures: list[PageImage]
    psnr: float | None
    text: str
    small: bool = False


class ColourBar(NamedTuple):
    """A colour bar: quantity, the values at both ends, and the CSS gradient."""

    label: str
    low: str
    high: str
    gradient: str


class ViewRows(NamedTuple):
    """Views with shared scales."""

    rows: list[ViewRow]
    bars: list[ColourBar]


class VolumeView(NamedTuple):
    """Slices of the volumes of a quantity.

    Attributes:
        title: caption, or the quantity.
        shape: voxels of the reconstruction along x, y, z.
        rows: middle slices, one row per plane.
        bars: colour bars.
        layers: xy slices from the lowest to the highest, for scrolling; empty for a single layer.
    """

    title: str
    shape: tuple[int, ...]
    rows: list[dict[str, Any]]
    bars: list[ColourBar]
    layers: list[dict[str, Any]]


def make_view_rows(folder: Path, images: Sequence[Image]) -> ViewRows:
    """Return all views with a reference or a render on shared scales, held-out views first."""
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
    return ViewRows(rows, [_colour_bar(scales[role], label) for role, label in _bar_labels(scales, first)])


def _load(folder: Path, image: Image) -> NDArray:
    """Read the pixels of an image: linear float64 values, or the uint8 pixels of a PNG."""
    path = folder / image.path
    if path.suffix == ".png":
        return _png(path)
    if path.suffix == ".npy":
        return np.load(path, allow_pickle=False).astype(float)
    return _exr(path, image.layer)


def _exr(path: Path, layer: str) -> NDArray:
    stacked = stack_layers(read_exr(path)[0])
    names = [layer] if layer else ["", "Y", *(stacked if len(stacked) == 1 else ())]
    name = next((name for name in names if name in stacked), None)
    if name is None:
        listed = ", ".join(f'"{name}"' for name in stacked)
        raise MivolError(f"{path.name} has the layers {listed}; name one of these layers in the record.")
    return stacked[name].astype(float).reshape(*stacked[name].shape[:2], -1)[..., :3]


def _png(path: Path) -> NDArray[np.uint8]:
    try:
        pixels = imread(path, format="png")
    except (OSError, SyntaxError, ValueError) as error:
        raise MivolError(f"{path.name} is not a complete PNG ({error}); restore the file, or repeat the run.") from error
    rgb = np.repeat(pixels[..., None], 3, axis=2) if pixels.ndim == 2 else pixels[..., :3]
    return np.round(255 * rgb).astype(np.uint8)


def _check_sizes(view: str, roles: dict[str, NDArray]) -> None:
    sizes = {role: image.shape[:2] for role, image in roles.items()}
    if len(set(sizes.values())) > 1:
        listed = ", ".join(f"{role} {height} x {width}" for role, (height, width) in sizes.items())
        raise MivolError(f'images of view "{view}" differ in size ({listed}); render them at one size.')


def _add_differences(roles: dict[str, NDArray]) -> None:
    """Add the difference and the z-image to a view of linear values, and the absolute error to a view of 8-bit pixels."""
    if {"reference", "render"} <= roles.keys() and roles["reference"].dtype == roles["render"].dtype == np.uint8:
        roles["error"] = np.abs(roles["render"].astype(float) - roles["reference"]).mean(axis=2) / 255
    if not _are_linear(roles, "reference", "render"):
        return
    difference = roles["difference"] = roles["render"] - roles["reference"]
    if _are_linear(roles, "standard error"):
        with np.errstate(divide="ignore", invalid="ignore"):
            roles["z"] = np.where(difference == 0, 0.0, difference / roles["standard error"])


def _are_linear(roles: dict[str, NDArray], *names: str) -> bool:
    """Whether all named images exist and hold linear values, not the bytes of a PNG."""
    return all(name in roles and roles[name].dtype != np.uint8 for name in names)


def _scales(views: Iterable[dict[str, NDArray]]) -> dict[str, pixel_scale.Scale]:
    """Scales by role, shared by all views: values by the references, differences symmetric, z-images fixed."""
    views = [{role: image for role, image in roles.items() if _are_linear(roles, role)} for roles in views]
    radiances = [roles.get("reference", roles.get("render")) for roles in views]
    values = [image for image in radiances if image is not None]
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
    "z": Z_IMAGE,
}
PANELS_OF_LINES = {
    "reference": "Measured",
    "render": "Modelled",
    "difference": "Modelled − measured",
    "z": "Difference / noise",
}


def _panel_names(images: Iterable[Image]) -> dict[str, str]:
    """Names of the images of a view by role: a line integral is measured, not rendered."""
    return PANELS_OF_LINES if any(image.quantity == LINES for image in images) else PANELS


def _view(name: str, images: dict[str, Image], roles: dict[str, NDArray], scales: dict[str, pixel_scale.Scale]) -> ViewRow:
    names = _panel_names(images.values())
    pictures = [_picture(names[role], roles[role], scales.get(role)) for role in names if role in roles]
    facts = [next((image.caption for image in images.values() if image.caption), "")]
    psnr = None
    if _are_linear(roles, "reference", "difference"):
        psnr, errors = _agreement(roles["reference"], roles["difference"])
        facts.append(errors)
    if "z" in roles:
        facts.append(f"|z| > {Z_OUTLIER:g} in {np.mean(np.abs(roles['z']) > Z_OUTLIER):.1%} of the values")
    held_out = any(image.held_out for image in images.values())
    small = any(image.small for image in images.values())
    return ViewRow(name, held_out, pictures, psnr, " · ".join(fact for fact in facts if fact), small)


def _agreement(reference: NDArray, difference: NDArray) -> tuple[float | None, str]:
    """PSNR [dB], its peak the largest value of the reference (None if undefined), and the errors of the view as text."""
    broken = int(np.sum(~np.isfinite(difference)))
    if broken:
        return None, f"{broken} of {difference.size} values are not finite"
    mse, power, peak = (float(f(v)) for f, v in ((np.mean, difference**2), (np.mean, reference**2), (np.max, reference)))
    if mse == 0 or peak <= 0:
        return None, "identical" if mse == 0 else f"RMSE {np.sqrt(mse):.3g}"
    psnr = 10 * np.log10(peak**2 / mse)
    return psnr, f"PSNR {psnr:.1f} dB · nRMSE {np.sqrt(mse / power):.3g}"


def _picture(name: str, image: NDArray, scale: pixel_scale.Scale | None, aspect: float | None = None) -> PageImage:
    rgb = image if image.dtype == np.uint8 else pixel_scale.to_pixels(image, scale or pixel_scale.shared_scale(image))
    height, width = rgb.shape[:2]
    aspect = aspect or width / height
    page_aspect = min(max(aspect, 1 / WIDEST), WIDEST)
    name = name if page_aspect == aspect else f"{name}, stretched"
    return PageImage(name, pixel_scale.data_uri(rgb), width, height, page_aspect)


def encode_image(folder: Path, image: Image) -> PageImage:
    """Return a single image on its own scale."""
    return _picture(image.caption or image.view or Path(image.path).stem, _load(folder, image), None)


def encode_film(folder: Path, image: Image) -> tuple[str, str, bool]:
    """Return the caption of a film, its ``data:`` address, and whether the film is an animated image."""
    coded = base64.b64encode((folder / image.path).read_bytes()).decode()
    kind = FILMS[Path(image.path).suffix]
    return image.caption or image.view, f"data:{kind};base64,{coded}", kind.startswith("image/")


def _bar_labels(scales: dict[str, pixel_scale.Scale], image: Image | None) -> list[tuple[str, str]]:
    quantity = f"{image.quantity} [{image.unit}]" if image and image.unit else image.quantity if image else ""
    names = _panel_names([image] if image else [])
    labels = {
        "reference": f"{quantity[:1].upper()}{quantity[1:]}",
        "difference": names["difference"],
        "error": "|Render − reference|, mean over RGB [sRGB value]",
        "z": names["z"] if names is PANELS_OF_LINES else "z = difference / standard error",
    }
    return [(role, label) for role, label in labels.items() if role in scales]


def _colour_bar(scale: pixel_scale.Scale, label: str) -> ColourBar:
    stops = pixel_scale.to_pixels(np.linspace(scale.low, scale.high, 17)[None, :], scale)[0]
    gradient = ", ".join("#{:02x}{:02x}{:02x}".format(*stop) for stop in stops)
    # A percentile of zeros may be 1e-16.
    low = scale.low if abs(scale.low) > 1e-9 * scale.high else 0.0
    return ColourBar(label, f"{low:.3g}", f"{scale.high:.3g}", gradient)


# -- Volume -------------------------------------------------------------------------------------------------------------


def make_volume_views(folder: Path, volumes: Sequence[Volume]) -> list[VolumeView]:
    """Return the slices of every reconstructed volume. Volumes of the same caption and quantity belong together."""
    groups: dict[tuple[str, str], dict[str, Volume]] = {}
    for volume in volumes:
        groups.setdefault((volume.caption, volume.quantity), {})[volume.role] = volume
    return [_volume_view(folder, group) for group in groups.values() if "reconstruction" in group]


def _volume_view(folder: Path, by_role: dict[str, Volume]) -> VolumeView:
    """Slices of the truth, the reconstruction and their difference, one row per plane."""
    volumes = {role: read_volume(folder / by_role[role].path) for role in ("truth", "reconstruction") if role in by_role}
    size = by_role["reconstruction"].size or tuple(np.linalg.norm(volumes["reconstruction"].to_world[:3, :3], axis=0))
    grids = {role: volume.values for role, volume in volumes.items()}
    cuts = {role: pixel_scale.middle_slices(grid, size) for role, grid in grids.items()}
    reconstruction = grids["reconstruction"]
    if len(cuts) == 2 and grids["truth"].shape == reconstruction.shape:
        truth, cut = cuts["truth"].images, cuts["reconstruction"]
        cuts["difference"] = cut._replace(images={p: image - truth[p] for p, image in cut.images.items()})
        grids["difference"] = reconstruction - grids["truth"]
    first = next(iter(cuts.values()))
    values = pixel_scale.shared_scale(*first.images.values())
    scales = {"truth": values, "reconstruction": values}
    if "difference" in cuts:
        scales["difference"] = pixel_scale.signed_scale(*cuts["difference"].images.values())
    rows = [_plane(plane, cuts, scales) for plane in first.images] if len(cuts) > 1 else [_planes(first, values)]
    described = by_role["reconstruction"]
    unit = f" [{described.unit}]" if described.unit else ""
    bars = [_colour_bar(values, f"{described.quantity}{unit}")]
    if "difference" in scales:
        bars.append(_colour_bar(scales["difference"], f"Reconstruction − truth{unit}"))
    layers = [_layer(share, grids, scales, first.aspect["xy"]) for share in _layer_heights(reconstruction.shape[0])]
    return VolumeView(described.caption or described.quantity, reconstruction.shape[2::-1], rows, bars, layers)


def _layer_heights(count: int) -> list[float]:
    """Heights of the scrollable layers as shares of the volume's height, at most ``LAYERS``."""
    return [] if count < 2 else ((np.arange(min(count, LAYERS)) + 0.5) / min(count, LAYERS)).tolist()


def _layer(share: float, volumes: dict[str, NDArray], scales: dict[str, pixel_scale.Scale], aspect: float) -> dict[str, Any]:
    """The xy slices of all volumes at a share of their height, y upwards, edges of at most ``LAYER_EDGE`` pixels."""
    count = volumes["reconstruction"].shape[0]
    pictures = []
    for role, values in volumes.items():
        step = max(1, -(-max(values.shape[1:3]) // LAYER_EDGE))
        image = values[int(share * values.shape[0]), ::-step, ::step]
        pictures.append(_picture(role.capitalize(), image, scales[role], aspect))
    return {"name": "xy", "text": f"z = {int(share * count) + 1} of {count}", "pictures": pictures}


def _planes(cut: pixel_scale.Slices, scale: pixel_scale.Scale) -> dict[str, Any]:
    """The three middle slices of a volume in a row."""
    pictures = [_picture(f"{p}, {cut.where[p]}", image, scale, cut.aspect[p]) for p, image in cut.images.items()]
    return {"plane": "", "where": "", "pictures": pictures}


def _plane(plane: str, cuts: dict[str, pixel_scale.Slices], scales: dict[str, pixel_scale.Scale]) -> dict[str, Any]:
    pictures = [_picture(role.capitalize(), cut.images[plane], scales[role], cut.aspect[plane]) for role, cut in cuts.items()]
    return {"plane": plane, "where": cuts["reconstruction"].where[plane], "pictures": pictures}
