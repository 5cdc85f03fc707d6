"""Make the pictures of docs/gallery.md from the examples, small, and the page itself.

    scripts/gallery.py                     is docs/gallery.md what this script says?
    scripts/gallery.py --write             write the page anew
    scripts/gallery.py --draw fire knot    run these examples, and write their pictures anew; without a name all of them

Conventions. Examples run at small settings, and without public data: what stands in for it is procedural and seeded, so that
everybody gets these pictures, and none of them is of a file with a licence of its own. Runs lie in ``runs/gallery``.
"""

from __future__ import annotations

import argparse
import base64
import io
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import mivol  # noqa: F401  (chooses LLVM before anything loads it)
from mivol.report.page_images import PageImage, make_view_rows, make_volume_views
from mivol.report.record import read_record

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
PAGE, PICTURES, RUNS = ROOT / "docs" / "gallery.md", ROOT / "docs" / "gallery", ROOT / "runs" / "gallery"
HEIGHT, QUALITY = 240, 88
"""Height of a picture [pixel], and quality of its JPEG file."""

HEAD = """# Gallery

`scripts/gallery.py --draw` made each picture from an example with small settings. If an example uses public data, the picture
shows procedural data instead (`mivol fetch NAME` downloads the public data). The command below a picture runs the example with
its own settings; `scenes/NAME/README.md` describes it.

"""


def drawn(name: str) -> Callable[[Path], list[Image.Image]]:
    """A picture that the example writes itself."""
    return lambda folder: [Image.open(folder / name).convert("RGB")]


def compared(folder: Path) -> list[Image.Image]:
    """The first held-out view of a run beside its reference, and a slice of its volume beside the true volume if known."""
    record = read_record(folder)
    views = make_view_rows(folder, [image for image in record.images if image.view and image.held_out]).rows
    rows = [views[0].pictures[:2]] if views else []
    rows += [cut.rows[1]["pictures"][:2] for cut in make_volume_views(folder, record.volumes)[:1] if len(cut.rows) > 1]
    return [decoded(picture) for row in rows for picture in row]


def decoded(picture: PageImage) -> Image.Image:
    """A picture of a page as pixels, in its proportions."""
    image = Image.open(io.BytesIO(base64.b64decode(picture.uri.partition(",")[2]))).convert("RGB")
    return image.resize((max(1, round(image.height * picture.aspect)), image.height), Image.Resampling.NEAREST)


class Entry(NamedTuple):
    """An example of the gallery.

    Attributes:
        title, text: heading above the picture, text below it.
        command: command of the example, as the page prints it.
        runs: arguments of Python for the picture; ``{out}`` is the folder of the run.
        pictures: reads images from that folder, to show side by side.
    """

    title: str
    text: str
    command: str
    runs: tuple[str, ...]
    pictures: Callable[[Path], list[Image.Image]] = compared


PAIRS = "From the left: a held-out view by Mitsuba and by mivol; a slice of the true and of the reconstructed volume."
PHOTOS = "photographs.py --views 40 --size 96 --spp 32 -o {out}/photographs"

ENTRIES = {
    "demo": Entry(
        "A tangle that absorbs, from sixteen views",
        PAIRS,
        "mivol demo demo",
        ("-m mivol optimize scenes/demo/fit.toml -o {out} --set reference.spp=128",),
    ),
    "white_smoke": Entry(
        "Smoke that scatters, under a white sky",
        f"{PAIRS} From eight views; the example itself has sixteen.",
        "mivol demo white_smoke",
        ("-m mivol demo white_smoke -o {out} --set views.count=9 --set reference.held_out=[2] --set reference.spp=256",),
    ),
    "shepp_logan": Entry(
        "A phantom by cone beam",
        "From the left: a held-out projection, measured and modelled; a slice of the true and of the reconstructed volume.",
        "mivol demo shepp_logan",
        ("-m mivol optimize scenes/shepp_logan/fit.toml -o {out}",),
    ),
    "still_life": Entry(
        "A radiance field of photographs",
        "The held-out photograph with the largest error, and the same view of the field.",
        "mivol demo still_life",
        (
            f"scenes/still_life/{PHOTOS}",
            "-m mivol optimize scenes/still_life/fit.toml -o {out} --set photos.path={out}/photographs --set field.effort=0.3",
        ),
    ),
    "gaussians": Entry(
        "Gaussians of the same photographs",
        "The held-out photograph with the largest error, and the same view of the Gaussians.",
        "mivol demo gaussians",
        (
            f"scenes/still_life/{PHOTOS}",
            "-m mivol optimize scenes/still_life/gaussians.toml -o {out} --set photos.path={out}/photographs "
            "--set gaussians.minutes=0.3",
        ),
    ),
    "fog": Entry(
        "Gaussians in fog",
        "Rays are traced through the Gaussians, also by a ball of steel, by a ball of glass (upside down), and through fog.",
        "python scenes/fog/render.py",
        ("scenes/fog/render.py --size 180 --spp 32 -o {out}",),
        drawn("fog.png"),
    ),
    "knot": Entry(
        "A knot of needles under a lamp",
        "The Gaussians are the extinction of a medium: they scatter light, and cast shadows on each other and on the floor.",
        "python scenes/knot/render.py",
        ("scenes/knot/render.py --size 180 --spp 32 -o {out}",),
        drawn("knot.png"),
    ),
    "scan_view": Entry(
        "A scan through tables of opacity and colour",
        "The gradient of the volume shades its surfaces, and a table of the gradient's magnitude emphasises boundaries.",
        "python scenes/scan_view/tables.py",
        ("scenes/scan_view/tables.py --size 240 --spp 8 --iterations 1 -o {out}",),
        drawn("tooth.png"),
    ),
    "explosion": Entry(
        "An explosion, from a .vdb with density and temperature",
        "A simulation, written as bricks and rendered from the file: glowing gas in scattering soot, over a plain at dusk.",
        "python scenes/explosion/render.py",
        ("scenes/explosion/render.py --cells 80 --size 240 --spp 256 -o {out}",),
        drawn("explosion.png"),
    ),
    "fire": Entry(
        "A fire, from temperature and soot",
        "Hot gas (black-body radiation) and soot; the fire lights the floor. The exposure is chosen from the picture.",
        "python scenes/fire/render.py",
        ("scenes/fire/render.py --size 240 --spp 64 -o {out}",),
        drawn("fire.png"),
    ),
    "big_cloud": Entry(
        "A cloud of 1024 x 1024 x 1024 voxels",
        "A sparse grid under a sun and a sky, with up to 47 scatterings.",
        "python scenes/big_cloud/render.py",
        ("scenes/big_cloud/render.py --voxels 512 --size 240 --spp 96 -o {out}",),
        drawn("cloud.png"),
    ),
}


def page() -> str:
    """The page: a picture, a sentence and a command each."""
    parts = [
        f"## {entry.title}\n\n![{entry.title}](gallery/{name}.jpg)\n\n{entry.text} `{entry.command}`\n"
        for name, entry in ENTRIES.items()
    ]
    return HEAD + "\n".join(parts)


def draw(name: str) -> Path:
    """Run an example without public data, and write its picture."""
    out = RUNS / name
    out.mkdir(parents=True, exist_ok=True)
    nowhere = out / "no_data"
    around = {**os.environ, "MIVOL_DATA": str(nowhere), "MIVOL_CACHE": str(nowhere), "PYTHONPATH": str(ROOT)}
    for words in ENTRIES[name].runs:
        subprocess.run([sys.executable, *words.format(out=out).split()], check=True, cwd=ROOT, env=around)
    row = joined(ENTRIES[name].pictures(out))
    path = PICTURES / f"{name}.jpg"
    PICTURES.mkdir(exist_ok=True)
    row.save(path, quality=QUALITY, optimize=True)
    return path


def joined(images: Sequence[Image.Image]) -> Image.Image:
    """Pictures side by side on white, all HEIGHT pixels high; small ones keep their pixels as squares."""
    gap, shown = HEIGHT // 30, []
    for image in images:
        how = Image.Resampling.NEAREST if image.height < HEIGHT else Image.Resampling.LANCZOS
        shown.append(image.resize((round(image.width * HEIGHT / image.height), HEIGHT), how))
    row = Image.new("RGB", (sum(image.width + gap for image in shown) - gap, HEIGHT), "white")
    left = 0
    for image in shown:
        row.paste(image, (left, 0))
        left += image.width + gap
    return row


def main(argv: list[str] | None = None) -> int:
    """0 where the page is what this script says, and every picture is there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write the page anew")
    parser.add_argument("--draw", nargs="*", metavar="name", choices=ENTRIES, help="run examples and write their pictures")
    given = parser.parse_args(argv)
    for name in ENTRIES if given.draw == [] else given.draw or ():
        print(draw(name))
    if given.write:
        PAGE.write_text(page(), encoding="utf-8")
    missing = [name for name in ENTRIES if not (PICTURES / f"{name}.jpg").is_file()]
    if missing:
        print(f"no picture of {', '.join(missing)}: run scripts/gallery.py --draw {' '.join(missing)}.", file=sys.stderr)
    if not PAGE.is_file() or PAGE.read_text(encoding="utf-8") != page():
        print("docs/gallery.md is not what scripts/gallery.py says: run it with --write.", file=sys.stderr)
        return 1
    return bool(missing)


if __name__ == "__main__":
    sys.exit(main())
