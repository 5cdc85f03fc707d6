"""One page that a colleague can be sent: the result first, then why to believe it, then how it was made.

Conventions. :func:`write_page` reads a run's folder (:mod:`mivol.report.record`) and writes ``report.html`` into it, one
file that loads nothing from anywhere: styles and curves inline, pictures as ``data:`` addresses. All pictures of one
kind share one scale, which stands beside them. The page is the same bytes for the same folder. What the record does not
have, the page does not show.
"""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np
from matplotlib.image import imread
from numpy.typing import NDArray

from mivol.cite import citations
from mivol.errors import MivolError
from mivol.files import layers, read_exr, read_volume, write_whole_text
from mivol.report import figures, show
from mivol.report.record import QUANTITIES, Image, Quantity, RunRecord, Volume, read_metrics, read_record

__all__ = ["PAGE", "headline", "write_page"]

PAGE = "report.html"
SHOWN_VIEWS = 4
Z_LIMIT = 4.0
Z_ODD = 3.0
FILMS = {".mp4": "video/mp4", ".webp": "image/webp", ".gif": "image/gif"}
VERDICTS = {"finished": "Reconstructed in", "stopped": "Stopped after", "running": "Still running after"}


class Picture(NamedTuple):
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


class ShownView(NamedTuple):
    """A row of pictures of one view with its numbers."""

    name: str
    held_out: bool
    pictures: list[Picture]
    psnr: float | None
    text: str


class Bar(NamedTuple):
    """A colour bar: what it measures, its ends, and its CSS gradient."""

    label: str
    low: str
    high: str
    gradient: str


class Gallery(NamedTuple):
    """Views that share scales."""

    rows: list[ShownView]
    bars: list[Bar]


class Cut(NamedTuple):
    """Slices of one quantity's volumes, one row a plane, and the voxels of the reconstruction along x, y, z."""

    title: str
    shape: tuple[int, ...]
    rows: list[dict[str, Any]]
    bars: list[Bar]


def write_page(folder: str | Path) -> Path:
    """Write ``report.html`` from the record, the metrics, the images and the volumes of a run.

    Args:
        folder: the run's folder; a run that is not finished gives a page of what there is.

    Returns:
        Path of the page.

    Raises:
        MivolError: no record, a file that the record names is missing or cannot be read, images of one view differ in
            size, or a citation key is unknown.
    """
    folder = Path(folder)
    record, rows = read_record(folder), read_metrics(folder)
    _check_present(folder, record)
    groups = _views(folder, record.images)
    volumes = _volumes(folder, record.volumes)
    facts = {
        "record": record,
        "headline": headline(record, _held_out_psnr(record, groups.rows)),
        "numbers": _numbers(record, groups.rows, volumes),
        "views": groups,
        "shown": SHOWN_VIEWS,
        "volumes": volumes,
        "curves": _curves(rows),
        "timings": _timings(record.timings),
        "films": [_film(folder, image) for image in record.images if image.role == "film"],
        "others": [_plain_picture(folder, image) for image in record.images if image.role in ("slice", "picture")],
        "config": _toml(record.config),
        "citations": citations(record.citations),
        "theme": figures.CSS,
    }
    template = _environment().get_template("page.html.jinja")
    write_whole_text(folder / PAGE, template.render(facts))
    return folder / PAGE


def headline(record: RunRecord, held_out_psnr: Sequence[float] = ()) -> str:
    """The result in one sentence: how long, how well on views that were not fitted, how well in the volume.

    Args:
        record: its ``status``, ``timings`` and ``results`` are used.
        held_out_psnr: PSNR [dB] of each held-out view.
    """
    found = []
    if held_out_psnr:
        found.append(f"held-out views to {np.mean(held_out_psnr):.1f} dB PSNR")
    if record.results.get("nrmse") is not None:
        found.append(f"the volume to an nRMSE of {record.results['nrmse']:.3g}")
    cores = f"{record.machine.cores} core" + ("s" if record.machine.cores != 1 else "")
    seconds = _seconds(record)
    when = f"{VERDICTS[record.status]} {_duration(seconds)}" if seconds else VERDICTS[record.status].rpartition(" ")[0]
    return f"{when} on {cores}" + (": " + ", ".join(found) if found else "") + "."


def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("mivol.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(duration=_duration, times=_times, unbroken=_unbroken)
    return environment


def _unbroken(sentence: str) -> str:
    """The sentence with numbers kept beside their units at the end of a line."""
    return re.sub(r"(\d) (?=\D)", "\\1\u00a0", sentence).replace("held-out", "held\u2011out")


def _check_present(folder: Path, record: RunRecord) -> None:
    for part in (*record.images, *record.volumes):
        if not (folder / part.path).is_file():
            raise MivolError(
                f'the record names "{part.path}", which is not in the run folder; put the file back or take '
                "its entry out of run.json."
            )


# -- Views --------------------------------------------------------------------------------------------------------------


def _views(folder: Path, images: Sequence[Image]) -> Gallery:
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
    first = next(iter(images), None)
    return Gallery(rows, [_bar(scales[role], label) for role, label in _bar_labels(scales, first)])


def _load(folder: Path, image: Image) -> NDArray:
    """Pixels of an image: float64 linear values, or uint8 of a PNG that is shown as it is."""
    path = folder / image.path
    if path.suffix == ".png":
        return _png(path)
    if path.suffix == ".npy":
        return np.load(path, allow_pickle=False).astype(float)
    return _exr(path, image.layer)


def _exr(path: Path, layer: str) -> NDArray:
    stacked = layers(read_exr(path)[0])
    wanted = [layer] if layer else ["", "Y", *(stacked if len(stacked) == 1 else ())]
    name = next((name for name in wanted if name in stacked), None)
    if name is None:
        listed = ", ".join(f'"{name}"' for name in stacked)
        raise MivolError(f"{path.name} has the layers {listed}; name one of them in the record.")
    return stacked[name].astype(float).reshape(*stacked[name].shape[:2], -1)[..., :3]


def _png(path: Path) -> NDArray[np.uint8]:
    pixels = imread(path, format="png")
    rgb = np.repeat(pixels[..., None], 3, axis=2) if pixels.ndim == 2 else pixels[..., :3]
    return np.round(255 * rgb).astype(np.uint8)


def _check_sizes(view: str, roles: dict[str, NDArray]) -> None:
    sizes = {role: image.shape[:2] for role, image in roles.items()}
    if len(set(sizes.values())) > 1:
        listed = ", ".join(f"{role} {height} x {width}" for role, (height, width) in sizes.items())
        raise MivolError(f'images of view "{view}" differ in size ({listed}); render them at one size.')


def _add_differences(roles: dict[str, NDArray]) -> None:
    """Put the difference and the z-image beside a reference and a render of linear values."""
    if not _are_numbers(roles, "reference", "render"):
        return
    difference = roles["difference"] = roles["render"] - roles["reference"]
    if _are_numbers(roles, "standard error"):
        with np.errstate(divide="ignore", invalid="ignore"):
            roles["z"] = np.where(difference == 0, 0.0, difference / roles["standard error"])


def _are_numbers(roles: dict[str, NDArray], *names: str) -> bool:
    """True where all of these are there and hold linear values, not the bytes of a PNG."""
    return all(name in roles and roles[name].dtype != np.uint8 for name in names)


def _scales(views: Iterable[dict[str, NDArray]]) -> dict[str, show.Scale]:
    """Scales by role, each shared by all views: values from the references, differences symmetric, z fixed."""
    views = [{role: image for role, image in roles.items() if _are_numbers(roles, role)} for roles in views]
    shown = [roles.get("reference", roles.get("render")) for roles in views]
    values = [image for image in shown if image is not None]
    differences = [roles["difference"] for roles in views if "difference" in roles]
    scales = {}
    if values:
        scales["reference"] = scales["render"] = show.scale_of(*values)
    if differences:
        scales["difference"] = show.signed_scale(*differences)
    if any("z" in roles for roles in views):
        scales["z"] = show.Scale("signed", -Z_LIMIT, Z_LIMIT)
    return scales


PANELS = {"reference": "Reference", "render": "Render", "difference": "Render − reference", "z": "z-image"}


def _view(name: str, images: dict[str, Image], roles: dict[str, NDArray], scales: dict[str, show.Scale]) -> ShownView:
    pictures = [_picture(PANELS[role], roles[role], scales.get(role)) for role in PANELS if role in roles]
    words = [next((image.caption for image in images.values() if image.caption), "")]
    psnr = None
    if _are_numbers(roles, "reference", "difference"):
        psnr, said = _agreement(roles["reference"], roles["difference"])
        words.append(said)
    if "z" in roles:
        words.append(f"|z| > {Z_ODD:g} in {np.mean(np.abs(roles['z']) > Z_ODD):.1%} of the values")
    held_out = any(image.held_out for image in images.values())
    return ShownView(name, held_out, pictures, psnr, " · ".join(word for word in words if word))


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


def _picture(name: str, image: NDArray, scale: show.Scale | None, aspect: float | None = None) -> Picture:
    rgb = image if image.dtype == np.uint8 else show.pixels(image, scale or show.scale_of(image))
    height, width = rgb.shape[:2]
    return Picture(name, show.data_uri(rgb), width, height, aspect or width / height)


def _plain_picture(folder: Path, image: Image) -> Picture:
    return _picture(image.caption or image.view or Path(image.path).stem, _load(folder, image), None)


def _film(folder: Path, image: Image) -> tuple[str, str, bool]:
    """The caption of a film, the film as an address, and whether it is an animated image."""
    coded = base64.b64encode((folder / image.path).read_bytes()).decode()
    kind = FILMS[Path(image.path).suffix]
    return image.caption or image.view, f"data:{kind};base64,{coded}", kind.startswith("image/")


def _bar_labels(scales: dict[str, show.Scale], image: Image | None) -> list[tuple[str, str]]:
    what = f"{image.quantity} [{image.unit}]" if image and image.unit else image.quantity if image else ""
    labels = {
        "reference": f"{what[:1].upper()}{what[1:]}",
        "difference": "Render − reference",
        "z": "z = difference / standard error",
    }
    return [(role, label) for role, label in labels.items() if role in scales]


def _bar(scale: show.Scale, label: str) -> Bar:
    stops = show.pixels(np.linspace(scale.low, scale.high, 17)[None, :], scale)[0]
    gradient = ", ".join("#{:02x}{:02x}{:02x}".format(*stop) for stop in stops)
    return Bar(label, f"{scale.low:.3g}", f"{scale.high:.3g}", gradient)


# -- Volume -------------------------------------------------------------------------------------------------------------


def _volumes(folder: Path, volumes: Sequence[Volume]) -> list[Cut]:
    """Slices of every volume that was reconstructed: those of one caption and quantity belong together."""
    groups: dict[tuple[str, str], dict[str, Volume]] = {}
    for volume in volumes:
        groups.setdefault((volume.caption, volume.quantity), {})[volume.role] = volume
    return [_cut(folder, group) for group in groups.values() if "reconstruction" in group]


def _cut(folder: Path, by_role: dict[str, Volume]) -> Cut:
    """Slices of the truth, the reconstruction and their difference, one row a plane."""
    data = {role: read_volume(folder / by_role[role].path) for role in ("truth", "reconstruction") if role in by_role}
    size = by_role["reconstruction"].size or tuple(np.linalg.norm(data["reconstruction"].to_world[:3, :3], axis=0))
    cuts = {role: show.slices(found.values, size) for role, found in data.items()}
    if len(cuts) == 2 and data["truth"].values.shape == data["reconstruction"].values.shape:
        truth, found = cuts["truth"].images, cuts["reconstruction"]
        cuts["difference"] = found._replace(images={p: image - truth[p] for p, image in found.images.items()})
    first = next(iter(cuts.values()))
    values = show.scale_of(*first.images.values())
    scales = {"truth": values, "reconstruction": values}
    if "difference" in cuts:
        scales["difference"] = show.signed_scale(*cuts["difference"].images.values())
    rows = [_plane(plane, cuts, scales) for plane in first.images] if len(cuts) > 1 else [_planes(first, values)]
    described = by_role["reconstruction"]
    bars = [_bar(values, f"{described.quantity} [{described.unit}]" if described.unit else described.quantity)]
    if "difference" in scales:
        bars.append(_bar(scales["difference"], "Reconstruction − truth"))
    return Cut(described.caption or described.quantity, data["reconstruction"].values.shape[2::-1], rows, bars)


def _planes(cut: show.Slices, scale: show.Scale) -> dict[str, Any]:
    """The three planes of one volume side by side."""
    pictures = [_picture(f"{p}, {cut.where[p]}", image, scale, cut.aspect[p]) for p, image in cut.images.items()]
    return {"plane": "", "where": "", "pictures": pictures}


def _plane(plane: str, cuts: dict[str, show.Slices], scales: dict[str, show.Scale]) -> dict[str, Any]:
    pictures = [_picture(role.capitalize(), cut.images[plane], scales[role], cut.aspect[plane]) for role, cut in cuts.items()]
    return {"plane": plane, "where": cuts["reconstruction"].where[plane], "pictures": pictures}


# -- Numbers, curves, times, settings -----------------------------------------------------------------------------------


def _held_out_psnr(record: RunRecord, views: Sequence[ShownView]) -> list[float]:
    """PSNR of the views that were not fitted: of those that are shown, or the mean of all that the run has judged itself."""
    judged = record.results.get("held_out_psnr")
    if judged is not None:
        return [judged]
    return [view.psnr for view in views if view.held_out and view.psnr is not None]


def _numbers(record: RunRecord, views: Sequence[ShownView], volumes: Sequence[Cut]) -> list[tuple[str, str, str]]:
    """Tiles under the headline: value, unit, label."""
    held_out = _held_out_psnr(record, views)
    seconds, said, tiles = _seconds(record), ("nrmse", "held_out_psnr", "seconds"), []
    if record.results.get("nrmse") is not None:
        tiles.append(_tile("nrmse", record.results["nrmse"]))
    if held_out:
        spread = f" ({min(held_out):.1f} to {max(held_out):.1f})" if len(held_out) > 1 else ""
        tiles.append((f"{np.mean(held_out):.1f}", "dB", f"PSNR, held-out views{spread}"))
    if seconds:
        tiles.append((*_duration(seconds).split(" "), "in all"))
    tiles += [_tile(name, value) for name, value in record.results.items() if name not in said]
    shapes = dict.fromkeys(volume.shape for volume in volumes)
    tiles += [(*_count(math.prod(shape)), f"voxels, {_times(shape)}") for shape in shapes]
    return tiles


def _tile(name: str, value: float | None) -> tuple[str, str, str]:
    quantity = QUANTITIES.get(name, Quantity(name.replace("_", " ")))
    if value is None:
        return "–", "", quantity.label
    return (f"{value:,.0f}" if float(value).is_integer() else f"{value:.3g}"), quantity.unit, quantity.label


def _curves(rows: Sequence[dict]) -> list[str]:
    """Curves of every number in the metrics: known ones first, then the others by name."""
    names = {name for row in rows for name, value in row.items() if value is not None} - {"iteration", "seconds"}
    ordered = [name for name in QUANTITIES if name in names] + sorted(names - set(QUANTITIES))
    labels = {name: QUANTITIES.get(name, Quantity(name)).label for name in ordered}
    return [figures.inline_svg(figures.plot_curve(rows, n), f"{labels[n]} against iterations") for n in ordered]


def _seconds(record: RunRecord) -> float:
    return record.results.get("seconds") or sum(record.timings.values())


def _timings(timings: dict[str, float]) -> list[tuple[str, float, float]]:
    """Stages with their seconds and their share of the longest, in percent."""
    longest = max(timings.values(), default=0.0) or 1.0
    return [(name, seconds, 100 * seconds / longest) for name, seconds in timings.items()]


def _count(number: int) -> tuple[str, str]:
    """A count to three digits, and its prefix."""
    for size, prefix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if number >= size:
            return f"{number / size:.3g}", prefix
    return str(number), ""


def _times(shape: Sequence[int]) -> str:
    return " × ".join(map(str, shape))


def _duration(seconds: float) -> str:
    if seconds < 0.95:
        return f"{1000 * seconds:.0f} ms"
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.1f} min"
    return f"{seconds / 3600:.1f} h"


def _toml(config: dict[str, Any], prefix: str = "") -> str:
    """The configuration as TOML: plain values first, then a table for each group; what is not set is left out."""
    config = {key: value for key, value in config.items() if value is not None}
    plain = [f"{key} = {_value(value)}" for key, value in config.items() if not isinstance(value, dict)]
    parts = ["\n".join(([f"[{prefix}]"] if prefix and plain else []) + plain)] if plain else []
    tables = {key: value for key, value in config.items() if isinstance(value, dict)}
    parts += [_toml(value, f"{prefix}.{key}" if prefix else key) for key, value in tables.items()]
    return "\n\n".join(part for part in parts if part)


def _value(value: Any) -> str:
    if isinstance(value, list) and any(isinstance(item, dict) for item in value):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_value(item)}" for key, item in value.items() if item is not None) + " }"
    return json.dumps(value, ensure_ascii=False)
