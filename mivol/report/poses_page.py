"""The page after a search for poses: cameras from above and from the side, errors, and what to do next."""

from __future__ import annotations

import base64
import html
import shlex
import tempfile
from pathlib import Path

from mivol.files import write_whole_text
from mivol.photos import survey_photos
from mivol.photos.poses import Poses
from mivol.report.cameras import plot_cameras

PAGE = "poses.html"

STYLE = (
    "body{font:16px sans-serif;max-width:60em;margin:2em auto;padding:0 1em}img{width:100%}pre{background:#eee;padding:.7em}"
)


def write_poses_page(folder: Path, poses: Poses) -> Path:
    """Write ``poses.html`` into the folder of the photographs, with everything in it.

    Raises:
        MivolError: a full disk, or a model that the reader refuses.
    """
    with tempfile.TemporaryDirectory() as place:
        plot_cameras(survey_photos(folder), Path(place) / "cameras.png")
        picture = base64.b64encode((Path(place) / "cameras.png").read_bytes()).decode()
    name = shlex.quote(str(folder))
    rows = [
        ("photographs with a pose", f"{len(poses.posed)} of {len(poses.posed) + len(poses.unposed)}"),
        ("mean reprojection error", f"{poses.error:.2f} pixels"),
        ("points", str(poses.points)),
        ("cameras (lens and size)", str(poses.cameras)),
        ("without a pose", ", ".join(poses.unposed) or "none"),
        ("in models of their own", ", ".join(", ".join(names) for names in poses.others) or "none"),
    ]
    table = "".join(f"<tr><th align=left>{html.escape(head)}</th><td>{html.escape(cell)}</td></tr>" for head, cell in rows)
    text = (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>Poses of {html.escape(folder.name)}</title>'
        f"<style>{STYLE}</style></head><body><h1>Poses of {html.escape(folder.name)}</h1><table>{table}</table>"
        f"<p>The cameras, with the box of a fit. An error above 1.5 pixels is a sign of blur, or of a subject that moved.</p>"
        f'<img alt="cameras" src="data:image/png;base64,{picture}"><p>Next:</p>'
        f"<pre>mivol view {html.escape(name)}\nmivol optimize --as gaussians {html.escape(name)}</pre></body></html>\n"
    )
    write_whole_text(folder / PAGE, text)
    return folder / PAGE
