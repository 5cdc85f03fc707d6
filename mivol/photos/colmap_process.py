"""Poses of photographs by COLMAP, as a program of its own: ``python colmap_process.py JOB.json``.

pycolmap brings its own zlib, which breaks Pillow's PNG in the same process. So mivol imports constants of this file alone.

Pairs. Of a short list of photographs all pairs are matched. Of a long one or a video (``sequential``), photographs are matched
with neighbours in the order of names and with photographs that look alike (:func:`find_alike`), which close a walk around it.

Global structure from motion (Pan et al. 2024) comes first. It averages the rotations of all photographs and finds all positions
together, so errors do not add up along a chain of photographs. If it leaves out photographs, has a doubtful error, or pairs of
photographs contradict it, poses are also found one by one (Schönberger and Frahm 2016), and the better model is kept
(:func:`rate_models`).

The job names ``images`` (folder), ``names`` (groups of photographs, one camera for each group), ``order`` (all photographs),
``masks`` (folder, or ""), ``database`` and ``models`` (where to write), ``sequential``, ``longest`` (edge of a photograph in
the search for features [pixel]), and ``aliases`` (names in the model for those in ``names``, which have no blanks). Lines of
JSON on the standard output are stages, facts about the matches, then the models.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

OVERLAP = 10
"""Neighbours on each side that are matched in a sequence; farther ones at 16, 32, ... steps are matched too."""

ALIKE = 10
"""Photographs that look most alike, matched with each photograph of a sequence."""

WORDS, SAMPLE, ROUNDS = 64, 200, 8
"""Visual words of an image signature, features of a photograph for finding words, and rounds of k-means."""

PARTS = 10
"""Parts in which features and matches are reported."""

STILL = 0.002
"""Median shift of a pair's common points, over the width, below which nothing moved between two photographs."""

TURN, FOCAL, EQUAL = 0.1, (0.4, 1.6), 1.03
"""Least median shift of a turn of the camera, over the width; focal lengths that are tried, over the width; and the largest
ratio of singular values that counts as equal."""

DOUBTFUL = 0.7
"""Mean reprojection error from which poses are also found one by one [pixel]."""

FEWEST = 15
"""Common points of a pair with an overlap (COLMAP's ``min_num_inliers``)."""

SURE, OFF, SPREAD = 100, 10.0, 0.1
"""Common points of a pair that contradict the poses: their least number, their least distance from the geometry of the poses
[pixel], and their least spread over the diagonal of a photograph. Their distance from the geometry of the pair is at most 4
pixels (COLMAP's ``max_error``). A small part that is there twice has less spread."""

AGAINST = 0.02
"""Share of the pairs with ``SURE`` common points that contradict the poses, above which the poses are doubtful."""


def say(**facts: object) -> None:
    """Print facts as a line of JSON."""
    print(json.dumps(facts), flush=True)


def run(job: dict) -> None:
    """Find features, match them, and build the models."""
    import pycolmap  # the extra ``poses``, in this process alone

    pycolmap.logging.minloglevel = 3
    database, images = Path(job["database"]), Path(job["images"])
    for names in job["names"]:
        find_features(pycolmap, job, names)
    with pycolmap.Database.open(database) as opened:
        pairs = list_pairs(job["order"], find_alike(opened) if job["sequential"] else None)
    match_pairs(pycolmap, database, pairs)
    say(matches=describe_matches(pycolmap, database, job["aliases"]))
    say(stage="poses of all photographs at once")
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = 0
    together = Path(job["models"]) / "together"
    together.mkdir()
    found = write_models(pycolmap, pycolmap.global_mapping(database, images, together, options), together, job)
    posed = max((len(model["names"]) for model in found), default=0)
    if posed < sum(map(len, job["names"])) or any(is_doubtful(model) for model in found):
        say(stage=f"{posed} photographs have poses; poses one by one")
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = 0
        apart = Path(job["models"]) / "one-by-one"
        apart.mkdir()
        others = write_models(pycolmap, pycolmap.incremental_mapping(database, images, apart, options), apart, job)
        found = max(found, others, key=rate_models)
    say(models=found)


def find_features(pycolmap: Any, job: dict, names: list[str]) -> None:
    """Find the features of photographs of one camera, in parts; photographs with features stay as they are."""
    reader, features = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    reader.mask_path, features.max_image_size = job["masks"], job["longest"]
    size = max(8, -(-len(names) // PARTS))
    for start in range(0, len(names), size):
        say(stage=f"features: {start} of {len(names)} photographs of a camera")
        part, mode = names[start : start + size], pycolmap.CameraMode.SINGLE
        pycolmap.extract_features(job["database"], job["images"], part, mode, reader, features, pycolmap.Device.cpu)
        if start == 0:
            with pycolmap.Database.open(job["database"]) as opened:
                reader.existing_camera_id = opened.read_image_with_name(names[0]).camera_id


def list_pairs(order: list[str], alike: dict[str, list[str]] | None) -> list[tuple[str, str]]:
    """The pairs to match: all, or (``alike`` given) the pairs of neighbours and of photographs that look alike."""
    if alike is None:
        return list(combinations(order, 2))
    steps = [*range(1, OVERLAP + 1), *(2**n for n in range(4, 31) if 2**n < len(order))]
    pairs = {(order[at], order[at + step]): None for step in steps for at in range(len(order) - step)}
    for name, others in alike.items():
        for other in others:
            if (other, name) not in pairs:
                pairs[name, other] = None
    return list(pairs)


def find_alike(database: Any) -> dict[str, list[str]]:
    """The ``ALIKE`` photographs most like each photograph.

    Each photograph is summed up by the residuals of its features about visual words, which are found in these photographs alone
    (vectors of locally aggregated descriptors: Jégou et al. 2010, with square roots of SIFT: Arandjelović and Zisserman 2012).
    """
    features = {}
    for image in database.read_all_images():
        rows = np.sqrt(np.asarray(database.read_descriptors(image.image_id).data, np.float32).reshape(-1, 128))
        features[image.name] = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-6)
    rng = np.random.default_rng(0)
    sample = np.concatenate([rows[rng.permutation(len(rows))[:SAMPLE]] for rows in features.values()])
    if len(sample) < WORDS:
        return {}
    words = sample[rng.permutation(len(sample))[:WORDS]]
    for _ in range(ROUNDS):
        nearest = find_words(sample, words)
        counts = np.bincount(nearest, minlength=WORDS)
        sums = np.zeros_like(words)
        np.add.at(sums, nearest, sample)
        words = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], words)
    names, signatures = list(features), []
    for rows in features.values():
        nearest, sums = find_words(rows, words), np.zeros_like(words)
        np.add.at(sums, nearest, rows - words[nearest])
        sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-6)
        signatures.append(sums.ravel() / max(float(np.linalg.norm(sums)), 1e-6))
    likeness = np.array(signatures) @ np.array(signatures).T
    np.fill_diagonal(likeness, -np.inf)
    best = np.argsort(-likeness, axis=1, kind="stable")[:, : min(ALIKE, len(names) - 1)]
    return {name: [names[other] for other in row] for name, row in zip(names, best, strict=True)}


def find_words(rows: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Index (N,) of the word nearest to each feature."""
    return np.argmin((words**2).sum(axis=1) - 2 * rows @ words.T, axis=1)


def match_pairs(pycolmap: Any, database: Path, pairs: list[tuple[str, str]]) -> None:
    """Match the features of pairs, in parts; pairs with matches stay as they are."""
    options, size = pycolmap.ImportedPairingOptions(), max(100, -(-len(pairs) // PARTS))
    options.match_list_path = database.with_name("pairs.txt")
    for start in range(0, len(pairs), size):
        say(stage=f"matches: {start} of {len(pairs)} pairs")
        text = "".join(f"{one} {other}\n" for one, other in pairs[start : start + size])
        options.match_list_path.write_text(text, encoding="utf-8")
        pycolmap.match_image_pairs(database, pairing_options=options, device=pycolmap.Device.cpu)


def describe_matches(pycolmap: Any, database: Path, aliases: dict[str, str]) -> dict:
    """Facts on the pairs with an overlap.

    Returns:
        ``pairs``: their number; ``still``: pairs between which nothing moved; ``turned``: pairs between which the camera turned
        on the spot; ``best``: for each photograph the one with the most common points, and their number.
    """
    flat = {getattr(pycolmap.TwoViewGeometryConfiguration, name) for name in ("PANORAMIC", "PLANAR_OR_PANORAMIC")}
    facts = {"pairs": 0, "still": 0, "turned": 0, "best": {}}
    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image for image in opened.read_all_images()}
        places = {number: opened.read_keypoints(number)[:, :2] for number in images}
        sizes = {number: opened.read_camera(image.camera_id) for number, image in images.items()}
        for one, other, matches, geometry in read_pairs(pycolmap, opened):
            for a, b in ((one, other), (other, one)):
                name, partner = (aliases.get(images[number].name, images[number].name) for number in (a, b))
                if len(matches) > facts["best"].get(name, ("", -1))[1]:
                    facts["best"][name] = partner, len(matches)
            if len(matches) < FEWEST:
                continue
            shifts = np.linalg.norm(places[one][matches[:, 0]] - places[other][matches[:, 1]], axis=1)
            shift, size = np.median(shifts) / sizes[one].width, (sizes[one].width, sizes[one].height)
            facts["pairs"] += 1
            facts["still"] += bool(shift < STILL)
            facts["turned"] += bool(shift > TURN and geometry.config in flat and is_turn(np.asarray(geometry.H), size))
    return facts


def read_pairs(pycolmap: Any, database: Any) -> Iterator[tuple[int, int, np.ndarray, Any]]:
    """Numbers of two photographs, the indices (N, 2) of their common points, and the relation between both views."""
    for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
        yield *pycolmap.pair_id_to_image_pair(pair), np.asarray(geometry.inlier_matches).reshape(-1, 2), geometry


def count_contradictions(pycolmap: Any, database: Path, model: Any) -> tuple[int, int]:
    """Pairs of at least ``SURE`` common points that contradict the poses of a model, and all such pairs.

    Parts that look alike and are taken for one part make such pairs.
    """
    against = count = 0
    with pycolmap.Database.open(database) as opened:
        for one, other, matches, _ in read_pairs(pycolmap, opened):
            views = [model.images[number] for number in (one, other) if number in model.images]
            if len(matches) < SURE or len(views) < 2 or not all(view.has_pose for view in views):
                continue
            relative = views[1].cam_from_world() * views[0].cam_from_world().inverse()
            places = [opened.read_keypoints(number)[rows, :2] for number, rows in zip((one, other), matches.T, strict=True)]
            rays = [view.camera.cam_from_img(place) for view, place in zip(views, places, strict=True)]
            distances = epipolar_distances(*rays, np.asarray(relative.rotation.matrix()), np.asarray(relative.translation))
            is_off = distances * views[0].camera.mean_focal_length() > OFF
            sizes = [np.hypot(view.camera.width, view.camera.height) for view in views]
            count += 1
            against += is_spread([place[is_off] / size for place, size in zip(places, sizes, strict=True)])
    return against, count


def is_spread(places: list[np.ndarray]) -> bool:
    """Whether points (N, 2) of both photographs, over their diagonals, are ``SURE`` and have a spread of ``SPREAD``."""
    return len(places[0]) >= SURE and all(np.linalg.norm(place.std(axis=0)) >= SPREAD for place in places)


def epipolar_distances(one: np.ndarray, other: np.ndarray, rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Distances (N,) of points of two images from a relative pose, to first order (Hartley and Zisserman 2004, 11.4.3).

    Args:
        one, other: points (N, 2) in units of the focal length.
        rotation, shift: (3, 3) and (3,), from the first camera to the second, as in OpenCV.
    """
    x, y = (np.column_stack([points, np.ones(len(points))]) for points in (one, other))
    essential = np.cross(shift, rotation, axisb=0, axisc=0)
    lines, back = x @ essential.T, y @ essential
    size = np.sqrt((lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
    return np.abs((y * lines).sum(axis=1)) / np.maximum(size, 1e-12)


def is_turn(homography: np.ndarray, size: tuple[int, int]) -> bool:
    """Whether a homography of pixels (3, 3) belongs to a turn on the spot, for a common focal length.

    It is K R K^-1 then, and K^-1 H K has three equal singular values (Hartley 1997, self-calibration of rotating cameras). A
    plane seen from two places has others.
    """
    ratios = []
    for focal in np.linspace(*FOCAL, 49) * size[0]:
        K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
        values = np.linalg.svd(np.linalg.inv(K) @ homography @ K, compute_uv=False)
        ratios.append(values[0] / max(float(values[2]), 1e-12))
    return min(ratios) < EQUAL


def write_models(pycolmap: Any, models: dict, place: Path, job: dict) -> list[dict]:
    """Write models to folders of ``place``; return the facts of each."""
    found = []
    for number, model in models.items():
        folder = place / str(number)
        folder.mkdir(exist_ok=True)
        for image in model.images.values():
            image.name = job["aliases"].get(image.name, image.name)
        model.write(folder)
        named = sorted(image.name for image in model.images.values() if image.has_pose)
        error, points = model.compute_mean_reprojection_error(), model.num_points3D()
        against = count_contradictions(pycolmap, Path(job["database"]), model)
        facts = {"folder": str(folder), "names": named, "error": error, "points": points, "against": against}
        found.append(facts | {"cameras": model.num_cameras()})
    return found


def is_doubtful(model: dict) -> bool:
    """Whether a model has a large reprojection error, or pairs that contradict it."""
    return model["error"] > DOUBTFUL or share_against(model) > AGAINST


def share_against(model: dict) -> float:
    """Share of the pairs with many common points that contradict a model."""
    against, count = model["against"]
    return against / max(count, 1)


def rate_models(found: list[dict]) -> tuple[float, int]:
    """Photographs of the largest model times the share of pairs that agree with it, and its points.

    With wrong poses, fewer matches agree on a point.
    """
    return max(((len(model["names"]) * (1 - share_against(model)), model["points"]) for model in found), default=(0, 0))


if __name__ == "__main__":
    run(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
