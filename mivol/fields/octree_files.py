r"""Octrees in NumPy archives (``.npz``): mivol's own format, and the format of svox, the program of PlenOctrees.

The format of mivol. ``tree`` lists the inner nodes from the root, level by level, each level in the order of codes: two bytes a
node, a bit a child, for the children that are inner nodes and for those that are leaves. A file can therefore hold no cycle.
The values follow in the order of the leaves' codes. They are rounded: coefficients to multiples of ``step``, the extinction of
a leaf of edge h to 255 steps of log(1 + 20 sigma h), so that opacities err by at most 1.1 %. Red and blue
are stored as differences from green, the constant coefficients as differences of successive leaves, and all coefficients
apart, so that an archive packs them tightly.

The format of svox. ``child`` (nodes, 2, 2, 2) holds the distance from a node to its child among the nodes, 0 for a leaf, with
the axes x, y, z. ``data`` (nodes, 2, 2, 2, 3 basis + 1) holds half floats, [rgb][basis] and the extinction per world length.
A world point p has the place offset + invradius p in the unit cube. Colours are sigmoids of the sums, densities below 0 count
as 0. In compressed files ``quant_colors`` (basis, 65536, 3) and ``quant_map`` (basis, nodes, 2, 2, 2) hold the coefficients,
and ``sigma`` (nodes, 2, 2, 2) the extinctions.

Source: Yu et al. 2021 (PlenOctrees); the names of the arrays are read from svox's own files.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mivol.errors import MivolError
from mivol.fields.harmonics import harmonic_degree
from mivol.fields.octree import MAX_DEPTH, Octree, check_depth, edges_of
from mivol.files import write_whole
from mivol.files.npy import check_arrays, check_memory
from mivol.files.source import refusal
from mivol.photos.camera_path import HomeView

FORMAT = "mivol octree 1"

VIEW = "view"
"""Array with the numbers of the first view, as in the archive of a grid."""

STEPS = 1 / 32, 1 / 16
"""Steps of the constant coefficients and of the others, in code values or radiance: errors of a colour of at most 1/230 from
the constant, and of about 1/60 (one standard deviation) from eight others."""

FINENESS, GAIN = 24.0, 20.0
"""Codes of extinction: FINENESS log(1 + GAIN tau) for the optical depth tau of a leaf's edge."""

KINDS = {
    "depth": ("iu", ()), "to_world": ("f", (4, 4)), "tree": ("u", None), "density": ("uf", None), "constant": ("if", None),
    "directional": ("if", None), "step": ("f", (2,)), "colours": ("U", ()), "offset": ("f", ()), "space": ("U", ()),
}  # fmt: skip
"""Array -> allowed kinds of NumPy types, and its shape where the shape is fixed."""


# -- The format of mivol -----------------------------------------------------------------------------------------------


def write_octree(path: Path, tree: Octree, rounded: bool = True, view: HomeView | None = None) -> None:
    """Write an octree in mivol's own format; ``rounded`` False stores float32.

    Raises:
        MivolError: the disk refuses the file.
    """
    density, sh = tree.values()
    arrays = {"format": np.array(FORMAT), "depth": np.array(tree.depth), "to_world": tree.to_world, "tree": _node_bits(tree)}
    arrays |= {name: np.array(getattr(tree, name)) for name in ("colours", "offset", "space")}
    if view is not None:
        arrays[VIEW] = np.array(view.numbers)
    constant, rest = sh[:, 0].T, sh[:, 1:].transpose(1, 2, 0)
    if not rounded:
        arrays |= {"density": density, "constant": constant, "directional": rest, "step": np.zeros(2)}
    else:
        tau = density * tree.cell * edges_of(tree.sizes)
        arrays["density"] = np.rint(np.minimum(FINENESS * np.log1p(GAIN * tau), 255)).astype(np.uint8)
        arrays["constant"] = _smallest(np.diff(_from_green(np.rint(constant / STEPS[0])), prepend=0))
        arrays["directional"] = _smallest(_from_green(np.rint(rest / STEPS[1])))
        arrays["step"] = np.array(STEPS)
    write_whole(path, lambda file: np.savez_compressed(file, **arrays))


def _from_green(rounded: np.ndarray, sign: int = -1) -> np.ndarray:
    """Red, green and blue (..., 3, n) as differences from green; with the sign 1 the inverse."""
    made = rounded.copy()
    made[..., ::2, :] += sign * rounded[..., 1:2, :]
    return made


def _smallest(values: np.ndarray) -> np.ndarray:
    """Whole numbers in the smallest type that holds them."""
    largest = np.abs(values).max(initial=0)
    kind = next(kind for kind in (np.int8, np.int16, np.int32, np.int64) if largest <= np.iinfo(kind).max)
    return np.ascontiguousarray(values).astype(kind)


def _node_bits(tree: Octree) -> np.ndarray:
    """The array ``tree`` of an octree."""
    inner = _inner_codes(tree)
    rows = []
    for level, codes in enumerate(inner):
        row = np.zeros((len(codes), 2), np.uint8)
        children = [inner[level + 1]] if level + 1 < len(inner) else [np.zeros(0, np.uint64)]
        below = tree.depth - level - 1
        children.append(tree.codes[tree.sizes == below] >> np.uint64(3 * below))
        for column, own in enumerate(children):
            bit = np.uint8(1) << (own & np.uint64(7)).astype(np.uint8)
            np.bitwise_or.at(row[:, column], np.searchsorted(codes, own >> np.uint64(3)), bit)
        rows.append(row)
    return np.concatenate(rows) if rows else np.zeros((0, 2), np.uint8)


def _inner_codes(tree: Octree) -> list[np.ndarray]:
    """Codes of the inner nodes of each level, ascending; empty for an octree that is a single leaf."""
    levels = range(tree.depth - int(tree.sizes.min()))
    return [np.unique(tree.codes[tree.sizes < tree.depth - k] >> np.uint64(3 * (tree.depth - k))) for k in levels]


def is_octree(arrays: dict[str, np.ndarray]) -> bool:
    """Whether the arrays of an archive are an octree in mivol's own format."""
    return str(arrays.get("format", "")) == FORMAT


def parse_octree(name: str, arrays: dict[str, np.ndarray]) -> Octree:
    """Make an octree from the arrays of mivol's own format.

    Args:
        name: file name, for error messages.
        arrays: contents of the archive.

    Raises:
        MivolError: a missing array, another type or shape, values that are not finite, or a tree that contradicts itself.
    """
    missing = KINDS.keys() - arrays.keys()
    if missing:
        raise MivolError(f"{name} lacks {', '.join(sorted(missing))}, which an octree of mivol holds: write it again.")
    check_arrays(name, arrays, KINDS)
    depth = int(arrays["depth"])
    try:
        check_depth(depth)
        harmonic_degree(1 + len(np.atleast_1d(arrays["directional"])))
    except MivolError as error:
        raise MivolError(f"{name}: {error}") from None
    # A few bytes of a packed archive can describe millions of leaves: their number is compared first.
    n, constant, rest = _count_leaves(name, arrays["tree"]), arrays["constant"], arrays["directional"]
    if arrays["density"].shape != (n,) or constant.shape != (3, n) or rest.ndim != 3 or rest.shape[1:] != (3, n):
        found = f"densities {arrays['density'].shape} and coefficients {constant.shape} and {rest.shape}"
        wanted = f"({n},), (3, {n}) and (basis - 1, 3, {n}) are expected"
        raise MivolError(f"{name} holds {found} for {n} leaves; {wanted}: write it again.")
    check_memory(Path(name), n * (PLACE_BYTES + 4 * COPIES * (1 + 3 * (1 + len(rest)))))
    codes, sizes = _leaves_of(name, arrays["tree"], depth)
    density, sh = arrays["density"].astype(np.float32), np.concatenate([constant.astype(np.float32)[None], rest])
    step = arrays["step"]
    if step.any():
        edges = np.linalg.det(arrays["to_world"][:3, :3]) ** (1 / 3) / 2**depth * edges_of(sizes)
        density = np.expm1(density / np.float32(FINENESS)) / np.float32(GAIN) / edges.astype(np.float32)
        whole = np.cumsum(constant, axis=1, dtype=np.int64)[None], rest.astype(np.int64)
        sh = np.concatenate([_from_green(part, 1) * s for part, s in zip(whole, step, strict=True)])
    settings = {key: str(arrays[key]) for key in ("colours", "space")} | {"offset": float(arrays["offset"])}
    sh = np.ascontiguousarray(sh.transpose(2, 0, 1), np.float32)
    return Octree.from_rows(depth, arrays["to_world"], codes, sizes, density, sh, **settings)


PLACE_BYTES, COPIES = 44, 3
"""Memory of a leaf's place while it is read [bytes], measured, and copies of its values."""


def _count_leaves(name: str, tree: np.ndarray) -> int:
    """Leaves of the array ``tree``: its set bits; an empty one is a single leaf."""
    if tree.ndim != 2 or tree.shape[1] != 2:
        raise MivolError(f"{name} holds a tree of the shape {tree.shape}; (nodes, 2) is expected: write it again.")
    return int(np.unpackbits(tree[:, 1].astype(np.uint8)).sum()) if len(tree) else 1


def _leaves_of(name: str, tree: np.ndarray, depth: int) -> tuple[np.ndarray, np.ndarray]:
    """Codes and sizes of the leaves of the array ``tree``, in ascending order."""
    if not len(tree):
        return np.zeros(1, np.uint64), np.array([depth], np.uint8)
    codes, first, found = np.zeros(1, np.uint64), 0, []
    for level in range(depth):
        rows = tree[first : first + len(codes)]
        if len(rows) < len(codes) or (rows[:, 0] & rows[:, 1]).any():
            break
        first += len(codes)
        inner, leaves = (
            (codes[:, None] * np.uint64(8) + np.arange(8, dtype=np.uint64))[(rows[:, k, None] >> np.arange(8) & 1).astype(bool)]
            for k in (0, 1)
        )
        below = depth - level - 1
        found.append((leaves << np.uint64(3 * below), np.full(len(leaves), below, np.uint8)))
        codes = inner
        if not len(codes):
            break
    if len(codes) or first != len(tree):
        raise MivolError(
            f"{name} holds a tree of {len(tree)} nodes of which some are missing, left over or both node and leaf; "
            f"one that ends at its leaves by depth {depth} is expected: write it again."
        )
    all_codes, sizes = (np.concatenate(part) for part in zip(*found, strict=True))
    order = np.argsort(all_codes)
    return all_codes[order], sizes[order]


# -- The format of svox ------------------------------------------------------------------------------------------------


def is_svox(arrays: dict[str, np.ndarray]) -> bool:
    """Whether the arrays of an archive are an octree of svox."""
    return "child" in arrays and ("invradius" in arrays or "invradius3" in arrays)


def write_svox(path: Path, tree: Octree) -> None:
    """Write an octree of svox, uncompressed, with half floats; colours max(0, .) are fitted by sigmoids.

    Raises:
        MivolError: a turned octree, linear radiance, values beyond half floats, or a full disk.
    """
    scale = np.diagonal(tree.to_world)[:3]
    if np.count_nonzero(tree.to_world[:3, :3] - np.diag(scale)) or scale.min() <= 0:
        raise refusal(path, "a turned or mirrored octree", "an axis-aligned cube, as svox has", "write .npz")
    if tree.space != "srgb":
        raise refusal(path, "colours of linear radiance", "code values, as svox shows them", "write .npz")
    tree = tree.with_colours("sigmoid")
    density, sh = tree.values()
    largest = max(float(np.abs(values).max()) for values in (density, sh))
    if largest > float(np.finfo(np.float16).max):
        raise refusal(path, f"values of up to {largest:g}", "at most 65504, a half float's", "write .npz")
    inner = _inner_codes(tree)
    if not inner:
        raise refusal(path, "an octree that is a single leaf", "a root with children, as svox has", "write .npz")
    starts = np.concatenate([[0], np.cumsum([len(codes) for codes in inner])])
    child, data = np.zeros((starts[-1], 8), np.int32), np.zeros((starts[-1], 8, 3 * tree.basis + 1), np.float16)
    rows = np.concatenate([sh.transpose(0, 2, 1).reshape(len(sh), -1), density[:, None]], axis=1).astype(np.float16)
    for level, codes in enumerate(inner):
        if level + 1 < len(inner):
            own = inner[level + 1]
            node = np.searchsorted(codes, own >> np.uint64(3))
            distance = starts[level + 1] + np.arange(len(own)) - starts[level] - node
            child[starts[level] + node, _svox_slot(own)] = distance
        below = tree.depth - level - 1
        leaves = np.flatnonzero(tree.sizes == below)
        own = tree.codes[leaves] >> np.uint64(3 * below)
        data[starts[level] + np.searchsorted(codes, own >> np.uint64(3)), _svox_slot(own)] = rows[leaves]
    invradius = 1 / scale
    depths = np.repeat(np.arange(len(inner)), np.diff(starts))
    arrays = {
        "data_dim": np.array(data.shape[2]), "child": child.reshape(-1, 2, 2, 2), "data_format": np.array(f"SH{tree.basis}"),
        "data": data.reshape(-1, 2, 2, 2, data.shape[2]), "n_internal": np.array(len(child)), "n_free": np.array(0),
        "invradius3": invradius.astype(np.float32), "offset": (-tree.to_world[:3, 3] * invradius).astype(np.float32),
        "depth_limit": np.array(MAX_DEPTH), "geom_resize_fact": np.array(1.0), "parent_depth": _parents(child, depths),
    }  # fmt: skip
    write_whole(path, lambda file: np.savez_compressed(file, **arrays))


def _svox_slot(codes: np.ndarray) -> np.ndarray:
    """Flat numbers in [x][y][z] of children, from their codes (x in bit 0)."""
    x, y, z = ((codes >> np.uint64(axis) & np.uint64(1)).astype(np.int64) for axis in range(3))
    return 4 * x + 2 * y + z


def _parents(child: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """The array ``parent_depth`` (nodes, 2): flat slot of the parent's entry, and depth of each node."""
    table = np.zeros((len(child), 2), np.int32)
    node, slot = np.nonzero(child)
    table[node + child[node, slot], 0] = 8 * node + slot
    table[:, 1] = depths
    return table


def parse_svox(name: str, arrays: dict[str, np.ndarray]) -> Octree:
    """Make an octree from the arrays of svox's format; leaves without density are left out.

    Args:
        name: file name, for error messages.
        arrays: contents of the archive.

    Raises:
        MivolError: a missing array, shapes that disagree, values that are not finite, colours that are no harmonics, a node
            with two parents or a cycle, or a depth above ``MAX_DEPTH``.
    """
    child = arrays["child"]
    if child.ndim != 4 or child.shape[1:] != (2, 2, 2) or child.dtype.kind not in "iu" or not len(child):
        raise MivolError(f"{name} holds child of type {child.dtype} and shape {child.shape}; (nodes, 2, 2, 2) is expected.")
    check_memory(Path(name), 8 * len(child) * 128)
    density, sh = _svox_values(name, arrays, len(child))
    child = child.reshape(-1, 8).astype(np.int64)
    node, code, leaves, seen = np.zeros(1, np.int64), np.zeros(1, np.uint64), [], np.zeros(len(child), bool)
    seen[0] = True
    for level in range(MAX_DEPTH + 1):
        if not len(node):
            break
        if level == MAX_DEPTH:
            raise MivolError(
                f"{name} holds an octree of a depth above {MAX_DEPTH}; at most {MAX_DEPTH} is expected: write fewer levels."
            )
        entry = child[node]
        slot = np.arange(8)
        codes = code[:, None] * np.uint64(8) + _svox_code(slot)
        is_leaf = entry == 0
        leaves.append((codes[is_leaf], (8 * node[:, None] + slot)[is_leaf], level + 1))
        node, code = (node[:, None] + entry)[~is_leaf], codes[~is_leaf]
        if len(node) and (node.min() < 0 or node.max() >= len(child)):
            wrong = node[(node < 0) | (node >= len(child))][0]
            raise MivolError(f"{name} names node {wrong} as a child; nodes 0 to {len(child) - 1} are expected: write it again.")
        if len(np.unique(node)) < len(node) or seen[node].any():
            raise MivolError(
                f"{name} holds a node with two parents or a cycle; one parent for each node is expected: write it again."
            )
        seen[node] = True
    depth = leaves[-1][2]
    codes = np.concatenate([codes << np.uint64(3 * (depth - level)) for codes, _, level in leaves])
    rows = np.concatenate([row for _, row, _ in leaves])
    sizes = np.concatenate([np.full(len(row), depth - level, np.uint8) for _, row, level in leaves])
    density = np.maximum(density[rows], 0)
    kept = np.flatnonzero(density > 0)
    if not len(kept):
        raise MivolError(f"{name} holds no leaf with a density above 0; at least one is expected: write it again.")
    kept = kept[np.argsort(codes[kept])]
    return Octree.from_rows(
        depth, _svox_place(name, arrays), codes[kept], sizes[kept], density[kept], sh[rows[kept]], "sigmoid", 0.0
    )


def _svox_code(slot: np.ndarray) -> np.ndarray:
    """Codes of children, from their flat numbers in [x][y][z]."""
    return (slot >> 2 | (slot >> 1 & 1) << 1 | (slot & 1) << 2).astype(np.uint64)


def _svox_place(name: str, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """The placement of an octree of svox."""
    if "offset" not in arrays:
        raise MivolError(f"{name} lacks offset, which an octree of svox holds: write it again.")
    inverse, offset = arrays.get("invradius3", arrays.get("invradius")), arrays["offset"]
    if inverse.size not in (1, 3) or offset.size != 3 or not (np.isfinite(inverse).all() and np.isfinite(offset).all()):
        raise MivolError(f"{name} holds invradius {inverse.shape} and offset {offset.shape}; finite numbers are expected.")
    if not (inverse > 0).all():
        raise MivolError(f"{name} holds invradius {inverse.reshape(-1).tolist()}; numbers above 0 are expected.")
    scale = 1 / np.broadcast_to(inverse.astype(np.float64).reshape(-1), 3)
    to_world = np.diag([*scale, 1.0])
    to_world[:3, 3] = -offset.astype(np.float64).reshape(-1) * scale
    return to_world


def _svox_values(name: str, arrays: dict[str, np.ndarray], nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Densities (8 nodes,) and coefficients (8 nodes, basis, 3) of all entries."""
    quantised = "quant_colors" in arrays
    needed = {"quant_map", "sigma"} if quantised else {"data"}
    if missing := needed - arrays.keys():
        raise MivolError(
            f"{name} has child but lacks {', '.join(sorted(missing))}, which an octree of svox holds: write it again."
        )
    found = str(arrays["data_format"]) if "data_format" in arrays else ""
    if found and not (found.startswith("SH") and found[2:].isdigit()):
        raise MivolError(f"{name} is of svox's data format {found!r}; spherical harmonics (SH1, SH4, SH9, ...) are expected.")
    if quantised:
        density, sh = _quantised_values(name, arrays, nodes)
    else:
        data = arrays["data"]
        if data.ndim != 5 or data.shape[:4] != (nodes, 2, 2, 2) or data.dtype.kind != "f" or data.shape[4] % 3 != 1:
            shape = f"floats of the shape ({nodes}, 2, 2, 2, 3 basis + 1)"
            raise MivolError(f"{name} holds data of type {data.dtype} and shape {data.shape}; {shape} are expected.")
        rows = data.reshape(8 * nodes, -1).astype(np.float32)
        density, sh = rows[:, -1], rows[:, :-1].reshape(len(rows), 3, -1).transpose(0, 2, 1)
    harmonic_degree(sh.shape[1])
    if found and int(found[2:]) != sh.shape[1]:
        raise MivolError(
            f"{name} is of the data format {found} and holds {sh.shape[1]} harmonics; {found[2:]} are expected: write it again."
        )
    if not (np.isfinite(density).all() and np.isfinite(sh).all()):
        raise MivolError(
            f"{name} holds densities or harmonics that are not finite; finite numbers are expected: write it again."
        )
    return density, sh


def _quantised_values(name: str, arrays: dict[str, np.ndarray], nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Values of a compressed octree."""
    colours, places, sigma = (arrays[key] for key in ("quant_colors", "quant_map", "sigma"))
    is_sound = colours.ndim == 3 and colours.shape[2] == 3 and colours.dtype.kind == "f" and places.dtype.kind in "iu"
    if not is_sound or places.shape != (len(colours), nodes, 2, 2, 2) or sigma.size != 8 * nodes or sigma.dtype.kind != "f":
        found = f"quant_colors {colours.shape}, quant_map {places.shape} and sigma {sigma.shape}"
        raise MivolError(f"{name} holds {found} for {nodes} nodes; an entry for each node is expected: write it again.")
    if places.size and (int(places.max()) >= colours.shape[1] or int(places.min()) < 0):
        raise MivolError(
            f"{name} names colour {places.max()} of quant_colors; 0 to {colours.shape[1] - 1} are expected: write it again."
        )
    flat = places.reshape(len(colours), -1)
    sh = np.stack([colours[b].astype(np.float32)[flat[b]] for b in range(len(colours))], axis=1)
    return sigma.reshape(-1).astype(np.float32), sh
