"""Poses of photographs by COLMAP, as a program of its own: ``python colmap_process.py JOB.json``.

pycolmap brings its own zlib, which breaks Pillow's PNG in the same process. So nothing of mivol imports this file.

Global structure from motion (Pan et al. 2024) comes first. It averages the rotations of all photographs and finds all positions
together, so errors do not add up along a chain of photographs. If it leaves out photographs, poses are also found one by one
(Schönberger and Frahm 2016), and the larger model is kept.

The job names ``images`` (folder), ``names`` (groups of photographs, one camera for each group), ``masks`` (folder, or ""),
``database`` and ``models`` (where to write), ``sequential`` (match neighbours in the order of names only) and ``longest`` (edge
of a photograph in the search for features [pixel]). Lines of JSON on the standard output are stages, then the models.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path


def say(**facts: object) -> None:
    """Print facts as a line of JSON."""
    print(json.dumps(facts), flush=True)


def run(job: dict) -> None:
    """Find features, match them, and build the models."""
    import pycolmap  # the extra ``poses``, in this process alone

    pycolmap.logging.minloglevel = 3
    database, images, device = Path(job["database"]), Path(job["images"]), pycolmap.Device.cpu
    reader, features = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    reader.mask_path, features.max_image_size = job["masks"], job["longest"]
    single = pycolmap.CameraMode.SINGLE
    for names in job["names"]:
        say(stage=f"features of {len(names)} photographs")
        pycolmap.extract_features(database, images, names, single, reader, features, device)
    say(stage="matches")
    if job["sequential"]:
        pycolmap.match_sequential(database, device=device)
    else:
        pycolmap.match_exhaustive(database, device=device)
    say(stage="poses of all photographs at once")
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = 0
    together = Path(job["models"]) / "together"
    together.mkdir()
    found = write_models(pycolmap.global_mapping(database, images, together, options), together)
    if count_posed(found) < sum(map(len, job["names"])):
        say(stage=f"{count_posed(found)} photographs have poses; poses one by one")
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = 0
        apart = Path(job["models"]) / "one-by-one"
        apart.mkdir()
        others = write_models(pycolmap.incremental_mapping(database, images, apart, options), apart)
        found = max(found, others, key=count_posed)
    say(models=found)


def write_models(models: dict, place: Path) -> list[dict]:
    """Write models to folders of ``place``; return the facts of each."""
    found = []
    for number, model in models.items():
        folder = place / str(number)
        folder.mkdir(exist_ok=True)
        model.write(folder)
        named = sorted(image.name for image in model.images.values() if image.has_pose)
        error, points = model.compute_mean_reprojection_error(), model.num_points3D()
        found.append({"folder": str(folder), "names": named, "error": error, "points": points, "cameras": model.num_cameras()})
    return found


def count_posed(found: list[dict]) -> int:
    """Photographs of the largest model."""
    return max((len(model["names"]) for model in found), default=0)


if __name__ == "__main__":
    run(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
