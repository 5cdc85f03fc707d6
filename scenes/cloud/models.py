"""What too simple a model of light costs: a cloud fitted by one scattering, and by all, to the same photographs.

    python scenes/cloud/models.py [--models single all all_emission] [--scale 25] [-o runs/cloud_models]

The photographs are Mitsuba's (``volpath``) with all scattering: droplets of 10 micrometres (Mie), albedo 0.999, sun and sky.
The diffraction peak of the droplets, which hardly turns light, counts as light that is not scattered, as is usual (Wiscombe
1977, The delta-M method, J. Atmos. Sci. 34): extinctions are those of the rest.
Every fit is `mivol optimize scenes/cloud/deep.toml` with another model, from a constant fog or, for the models that end with
``emission``, from an emissive fit of the same views. Printed: PSNR of views that none has seen, by the model itself; nRMSE of
the extinction; and the root mean square error of the optical depths of vertical columns over that of the truth.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import mivol  # noqa: F401  (chooses the LLVM library; call it before the first variant)
from mivol.cli import main as mivol_main
from mivol.experiments.examples import EXAMPLES
from mivol.files import read_exr, read_volume, stack_layers
from mivol.optim.events import upsample
from mivol.phase.mie import water_droplets
from mivol.report import figures, pixel_scale
from mivol.report.record import RunRecord, read_record
from mivol.validate.metrics import nrmse

import matplotlib as mpl
import mitsuba as mi
import numpy as np

HERE = Path(__file__).parent
RADIUS = 10.0
"""Effective radius of the droplets [micrometre]."""
PEAK = 12.0
"""Angle [degree] within which the phase function is constant: the diffraction peak and a sun of one direction make rare
samples of thousands of times the mean, in Mitsuba's photographs as well."""
MODELS = {
    "single": ("one scattering", 2, ""),
    "single_emission": ("one scattering, emissive start", 2, "emission"),
    "all": ("all scattering", -1, ""),
    "all_emission": ("all scattering, emissive start", -1, "emission"),
}
"""Name: what it is called, max_depth, start_fit."""
FIGURES = {
    "held_out_psnr": "PSNR of\nviews not seen [dB]",
    "nrmse": "nRMSE of\nthe extinction",
    "columns": "nRMSE of optical\ndepths of columns",
}


def write_phase(path: Path) -> Path:
    """The phase function of the droplets as a table, constant within PEAK of straight on."""
    table = water_droplets(RADIUS)
    cosines = np.union1d(table.cosines, np.cos(np.deg2rad(PEAK)))
    values = np.interp(np.minimum(cosines, np.cos(np.deg2rad(PEAK))), table.cosines, table.values)
    rows = [f"{cosine!r},{value!r}" for cosine, value in zip(cosines.tolist(), values.tolist(), strict=True)]
    path.write_text("\n".join(["cos,value", *rows]) + "\n")
    return path


def fit(name: str, volume: Path, phase: Path, references: Path | None, given: argparse.Namespace) -> RunRecord:
    """The experiment with one model; references that are there are not rendered again."""
    folder = given.output / name
    if references is not None and not (folder / "references").exists():
        shutil.copytree(references, folder / "references")
    text, depth, start = MODELS[name]
    changes = [
        *(f"{rig}.{side}={given.size}" for rig in ("views", "held_out") for side in ("width", "height")),
        f'truth.file="{volume}"', f'scene.define.phase="{phase}"', f"scene.define.scale={given.scale}",
        f"fit.max_depth={depth}", f'parameter.0.start_fit="{start}"', f"fit.iterations={given.iterations}",
        f"event.0.at=[{given.iterations // 3}]", f"reference.spp={given.photo_spp}", f'title="A cumulus: {text}"',
    ]  # fmt: skip
    flags = [part for change in changes for part in ("--set", change)]
    if mivol_main(["optimize", str(HERE / "deep.toml"), "-o", str(folder), *flags]):
        raise SystemExit(f"the fit of {name} did not end well: see {folder / 'run.json'}.")
    return read_record(folder)


def volumes(home: Path, record: RunRecord) -> tuple[np.ndarray, np.ndarray]:
    """The truth, and what was found at its voxels, (Z, Y, X)."""
    found = {volume.role: read_volume(home / volume.path).values for volume in record.volumes}
    truth = found["truth"]
    return truth[..., 0], np.asarray(upsample(mi.TensorXf(found["reconstruction"]), truth.shape[:3]))[..., 0]


def columns(values: np.ndarray) -> np.ndarray:
    """Sums along z (Y, X): optical depths of vertical columns, in extinction of a voxel."""
    return values.sum(axis=0, dtype=np.float64)


def seen(home: Path, record: RunRecord) -> tuple[np.ndarray, np.ndarray]:
    """The first view that was held out, and what the fit shows of it."""
    parts = stack_layers(read_exr(home / next(image.path for image in record.images if image.held_out))[0])
    return parts["reference"], parts[""]


def main() -> None:
    """Fit, print a table, draw the chart."""
    given = arguments()
    given.output.mkdir(parents=True, exist_ok=True)
    volume = EXAMPLES["cloud"].stand_in.place(given.truth, given.output)
    phase = write_phase(given.output.resolve() / "droplets.csv")
    records: dict[str, RunRecord] = {}
    for name in given.models:
        references = given.output / next(iter(records)) / "references" if records else None
        records[name] = fit(name, volume, phase, references, given)
        truth, found = volumes(given.output / name, records[name])
        records[name].results["columns"] = nrmse(columns(found), columns(truth))
    for name, record in records.items():
        r = record.results
        print(
            f"{MODELS[name][0]}: {r['held_out_psnr']:.2f} dB on views not seen, nRMSE of the volume {r['nrmse']:.3f}, "
            f"optical depth of columns {r['columns']:.3f}, {r['fit_seconds']:.0f} s"
        )
    figures.save_figure(draw(given.output, records), given.output / "models.png")
    print(given.output / "models.png")


def draw(folder: Path, records: dict[str, RunRecord]) -> mpl.figure.Figure:
    """Truth and fits: a view that none has seen, and optical depths of columns; below them what is wrong."""
    with mpl.rc_context(figures.STYLE):
        figure = mpl.figure.Figure(figsize=(2.1 * (len(records) + 1), 6.6))
        above, below = figure.subfigures(2, 1, height_ratios=(3, 2))
        views, maps = above.subplots(2, len(records) + 1)
        first = next(iter(records))
        scale = pixel_scale.shared_scale(seen(folder / first, records[first])[0])
        top = columns(volumes(folder / first, records[first])[0])
        shown = [("truth", seen(folder / first, records[first])[0], top)]
        for name, record in records.items():
            text = MODELS[name][0].replace(", ", ",\n")
            shown.append((text, seen(folder / name, record)[1], columns(volumes(folder / name, record)[1])))
        for column, (text, view, depths) in enumerate(shown):
            views[column].imshow(pixel_scale.to_pixels(view, scale))
            views[column].set_title(text, fontsize=9, weight="normal")
            maps[column].imshow(depths, vmin=0, vmax=top.max(), cmap="magma", origin="lower")
            views[column].set_axis_off()
            maps[column].set_axis_off()
        for number, (axes, (key, label)) in enumerate(zip(below.subplots(1, len(FIGURES)), FIGURES.items(), strict=True)):
            axes.barh([MODELS[n][0] for n in records], [r.results[key] for r in records.values()], color=figures.SERIES[number])
            axes.invert_yaxis()
            axes.set_xlabel(label)
            axes.label_outer()
    return figure


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--models", nargs="+", choices=list(MODELS), default=["single", "all", "all_emission"])
    parser.add_argument("--truth", default="data:cloud", help="volume of extinctions [1/m]")
    parser.add_argument("--scale", type=float, default=25.0, help="100: the cloud as simulated; 25: a quarter of its density")
    parser.add_argument("--size", type=int, default=24, help="pixels along a side")
    parser.add_argument("--photo-spp", type=int, default=256, help="samples of the photographs")
    parser.add_argument("--iterations", type=int, default=120)
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/cloud_models"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
