"""Does every broken file end in one sentence? Mutate sound files of all formats by a seed, and read them.

A reader may take a broken file (a changed voxel is a voxel) or refuse it by a MivolError of one line. Anything else is a
fault: another exception, many lines or more than 1000 characters, a crash, a hang. Files are read in child processes with
a bound on memory and time, so that a crash names its file.

    scripts/fuzz_files.py                        20,000 files: about an hour of one core
    scripts/fuzz_files.py --files 300 --seed 7   fewer
    scripts/fuzz_files.py --only nrrd,colmap     of some formats
    scripts/fuzz_files.py --keep broken          keep the files that showed a fault there
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "tests"))

import mivol  # noqa: E402

import h5py  # noqa: E402
import mitsuba as mi  # noqa: E402
import numpy as np  # noqa: E402
from photo_sets import write_blender, write_colmap, write_transforms  # noqa: E402
from PIL import Image  # noqa: E402
from volume_files import les, mha, nifti, nrrd, numbered, pbrt, vol, vti, vtk  # noqa: E402

BATCH = 700
"""Files a child process reads."""

BATCH_SECONDS = 300
"""Sound files of these sizes take milliseconds: a batch that takes so long hangs."""

MEMORY = 6 << 30
"""Address space of a child beyond what it has when it begins: Mitsuba alone maps gigabytes."""

LONGEST = 1000
"""Characters of a sentence: of what it found, a refusal quotes no more than 300."""

CHILD = {"capture_output": True, "text": True, "errors": "replace", "timeout": BATCH_SECONDS, "check": False}

Read = Callable[[Path], object]


# -- Sound files -----------------------------------------------------------------------------------------------------------


def _bytes(data: bytes) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(data) and None


def _projections(path: Path) -> None:
    with h5py.File(path, "w") as file:
        rng = np.random.default_rng(0)
        for name, shape in (("data", (4, 3, 5)), ("data_white", (2, 3, 5)), ("data_dark", (2, 3, 5))):
            file[f"exchange/{name}"] = rng.integers(1, 999, shape).astype(np.uint16)
        file["exchange/theta"] = np.linspace(0, 180, 4, endpoint=False)


def _hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["density"] = numbered()[..., 0]


def _picture(path: Path) -> None:
    Image.fromarray(np.random.default_rng(1).integers(0, 256, (8, 12, 4), np.uint8)).save(path)


def _field(path: Path) -> None:
    from mivol.fields.spherical import SphericalGrid

    rng = np.random.default_rng(2)
    keep = rng.random((3, 4, 5)) < 0.5
    values = rng.random((3, 4, 5)), rng.normal(0, 1, (3, 4, 5, 4, 3))
    mivol.save_field(path, SphericalGrid.from_dense(*values, np.eye(4), keep))


def _svox2(path: Path) -> None:
    from mivol.fields.export import export_field
    from mivol.fields.spherical import SphericalGrid

    rng = np.random.default_rng(3)
    export_field(path, SphericalGrid.from_dense(rng.random((3, 4, 5)), rng.normal(0, 1, (3, 4, 5, 4, 3)), np.eye(4)))


def _mesh(path: Path) -> None:
    from mivol.files.mesh import Mesh, write_mesh

    points, faces = np.eye(4, 3), np.array([[0, 1, 2], [0, 1, 3]])
    write_mesh(path, Mesh(points, faces, colours=np.full((4, 3), 0.5)))


def _checkpoint(path: Path) -> None:
    rng = np.random.default_rng(4)
    np.savez(path, density=rng.random((3, 4)), state=np.array(json.dumps({"iteration": 3})))


def _read_field(path: Path) -> object:
    return mivol.load_field(path)


def _read_mesh(path: Path) -> object:
    from mivol.files.mesh import read_ply

    return read_ply(path)


def _read_exr(path: Path) -> object:
    from mivol.files import read_exr

    return read_exr(path)


def _read_projections(path: Path) -> object:
    from mivol.files import read_projections

    return read_projections(path)


def _read_stack(path: Path) -> object:
    from mivol.files import read_stack

    return read_stack(path)


def _read_archive(path: Path) -> object:
    from mivol.files.archive import read_archive

    return read_archive(path)


def _read_columns(path: Path) -> object:
    from mivol.files import read_columns

    return read_columns(path, 3)


def _read_picture(path: Path) -> object:
    from mivol.photos.picture import read_picture

    return read_picture(path, "srgb")


def _read_experiment(path: Path) -> object:
    from mivol import config

    return config.load(path)


def _of(values: np.ndarray) -> list[tuple]:
    z, y, x, _ = values.shape
    return [(i, j, k, float(values[k, j, i, 0]), 9.0) for k in range(z) for j in range(y) for i in range(x)]


def _volume_writer(path: Path) -> None:
    mivol.write_volume(path, numbered())


def _exr(path: Path) -> None:
    from mivol.files import write_exr

    write_exr(path, {"": np.random.default_rng(5).random((6, 7, 3)).astype(np.float32)})


FILES: dict[str, tuple[str, Callable[[Path], None], Read]] = {
    "vol": (".vol", _bytes(vol(numbered())), mivol.read_volume),
    "npy": (".npy", _volume_writer, mivol.read_volume),
    "npz": (".npz", _volume_writer, mivol.read_volume),
    "nrrd": (".nrrd", _bytes(nrrd(numbered())), mivol.read_volume),
    "nrrd gzip": (".nrrd", _bytes(nrrd(numbered(), encoding="gzip")), mivol.read_volume),
    "metaimage": (".mha", _bytes(mha(numbered())), mivol.read_volume),
    "nifti": (".nii", _bytes(nifti(numbered())), mivol.read_volume),
    "vti": (".vti", _bytes(vti(numbered())), mivol.read_volume),
    "vtk": (".vtk", _bytes(vtk(numbered())), mivol.read_volume),
    "vtk text": (".vtk", _bytes(vtk(numbered(), binary=False)), mivol.read_volume),
    "pbrt": (".pbrt", _bytes(pbrt(numbered())), mivol.read_volume),
    "les": (".txt", _bytes(les(_of(numbered()))), mivol.read_volume),
    "hdf5": (".h5", _hdf5, mivol.read_volume),
    "projections": (".h5", _projections, _read_projections),
    "stack": (".tif", lambda path: Image.fromarray(np.eye(8, 9, dtype=np.float32)).save(path), _read_stack),
    "exr": (".exr", _exr, _read_exr),
    "png": (".png", _picture, _read_picture),
    "jpeg": (".jpg", lambda path: Image.fromarray(np.eye(9, 8, dtype=np.uint8) * 200).save(path), _read_picture),
    "field": (".npz", _field, _read_field),
    "svox2": (".svox2.npz", _svox2, _read_field),
    "mesh": (".ply", _mesh, _read_mesh),
    "columns": (".txt", _bytes(b"# a table\n1 2 3\n4.5 -6 7e-3\n8 9 10\n"), _read_columns),
    "checkpoint": (".npz", _checkpoint, _read_archive),
    "toml": (".toml", lambda path: shutil.copy(ROOT / "scenes/demo/fit.toml", path) and None, _read_experiment),
    "toml scan": (".toml", lambda path: shutil.copy(ROOT / "scenes/shepp_logan/fit.toml", path) and None, _read_experiment),
}
"""Name: suffix, what writes a sound file, what reads it."""

SETS: dict[str, tuple[Callable[[Path], object], tuple[str, ...]]] = {
    "blender": (
        lambda folder: write_blender(folder, alpha=False),
        ("transforms_train.json", "transforms_test.json", "train/r_0.png"),
    ),
    "transforms": (lambda folder: write_transforms(folder, {"fl_x": 10.0, "w": 12, "h": 8}), ("transforms.json",)),
    "colmap": (
        lambda folder: write_colmap(folder),
        ("sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"),
    ),
    "colmap text": (
        lambda folder: write_colmap(folder, encoding="txt"),
        ("sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt"),
    ),
}
"""Name: what writes a sound set of photographs, and the files in it that are broken, one at a time."""


# -- Mutations -------------------------------------------------------------------------------------------------------------

NUMBERS = (b"0", b"-1", b"nan", b"inf", b"-inf", b"1e400", b"4294967296", b"99999999999999999999", b"1e-320", b"0x10", b"")
WORDS = (b"[", b"{", b"]", b'"', b"\xff\xfe", b"\x00", b"\n", b"%s", b"../../etc", b"[" * 3000, b"A" * 70000)


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """One to four changes: of bits, bytes, numbers in text or in binary, lines, the length."""
    for _ in range(int(rng.integers(1, 5))):
        data = CHANGES[int(rng.integers(len(CHANGES)))](data, rng)
    return data


def _place(data: bytes, rng: np.random.Generator) -> int:
    """A place, in half of the cases among the first 200 bytes: headers are where formats are fragile."""
    end = max(len(data), 1)
    return int(rng.integers(min(end, 200) if rng.random() < 0.5 else end))


def _flip(data: bytes, rng: np.random.Generator) -> bytes:
    k = _place(data, rng)
    return data[:k] + bytes([data[k] ^ (1 << int(rng.integers(8)))]) + data[k + 1 :] if data else data


def _overwrite(data: bytes, rng: np.random.Generator) -> bytes:
    k, n = _place(data, rng), int(rng.integers(1, 9))
    return data[:k] + rng.integers(0, 256, n, np.uint8).tobytes() + data[k + n :]


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: _place(data, rng)]


def _drop(data: bytes, rng: np.random.Generator) -> bytes:
    k = _place(data, rng)
    return data[:k] + data[k + int(rng.integers(1, 33)) :]


def _repeat(data: bytes, rng: np.random.Generator) -> bytes:
    k, n = _place(data, rng), int(rng.integers(1, 65))
    return data[:k] + data[k : k + n] * int(rng.integers(2, 5)) + data[k + n :]


def _insert(data: bytes, rng: np.random.Generator) -> bytes:
    k = _place(data, rng)
    return data[:k] + WORDS[int(rng.integers(len(WORDS)))] + data[k:]


def _number(data: bytes, rng: np.random.Generator) -> bytes:
    """Another number where text has one."""
    places = list(re.finditer(rb"-?\d+(\.\d+)?(e-?\d+)?", data[:20000]))
    if not places:
        return _overwrite(data, rng)
    found = places[int(rng.integers(len(places)))]
    return data[: found.start()] + NUMBERS[int(rng.integers(len(NUMBERS)))] + data[found.end() :]


def _word(data: bytes, rng: np.random.Generator) -> bytes:
    """An extreme 32-bit or 64-bit number in binary."""
    extreme = (0, -1, 1 << 30, (1 << 31) - 1, -(1 << 31))[int(rng.integers(5))]
    size = 4 if rng.random() < 0.7 else 8
    k = _place(data, rng) // 4 * 4
    return data[:k] + int(extreme).to_bytes(size, "little", signed=True) + data[k + size :]


def _line(data: bytes, rng: np.random.Generator) -> bytes:
    """A line that is gone, doubled, or at another place."""
    lines = data.split(b"\n")
    k = int(rng.integers(len(lines)))
    line = lines.pop(k)
    for _ in range(int(rng.integers(3))):
        lines.insert(int(rng.integers(len(lines) + 1)), line)
    return b"\n".join(lines)


CHANGES = (_flip, _overwrite, _cut, _drop, _repeat, _insert, _number, _number, _word, _line)


# -- Reading ---------------------------------------------------------------------------------------------------------------


def outcome(read: Callable[[], object]) -> tuple[str, str]:
    """("taken" | "refused" | "fault", what was said)."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read()
    except mivol.MivolError as error:
        text = str(error)
        sound = "\n" not in text and 0 < len(text) <= LONGEST
        return ("refused" if sound else "fault"), text
    except Exception as error:
        return "fault", f"{type(error).__name__}: {error}"
    return "taken", ""


def case(name: str, number: int, seed: int, folder: Path) -> tuple[Callable[[], object], Path]:
    """The broken file of a number, written; what reads it."""
    rng = np.random.default_rng((seed, number))
    if name in FILES:
        suffix, _, read = FILES[name]
        path = folder / f"sound{suffix}"
        broken = folder / f"broken{suffix}"
        broken.write_bytes(mutate(path.read_bytes(), rng))
        return (lambda: read(broken)), broken
    files = SETS[name][1]
    whole, copy = folder / "sound", folder / "broken"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(whole, copy)
    broken = copy / files[int(rng.integers(len(files)))]
    broken.write_bytes(mutate(broken.read_bytes(), rng))
    return (lambda: mivol.load_photos(copy)), broken


def write_sound(name: str, folder: Path) -> None:
    """The sound file or set that is broken; it must be taken itself."""
    if name in FILES:
        suffix, write, read = FILES[name]
        path = folder / f"sound{suffix}"
        write(path)
        read(path)
        return
    whole = folder / "sound"
    whole.mkdir()
    SETS[name][0](whole)
    mivol.load_photos(whole)


def read_batch(name: str, first: int, count: int, seed: int, folder: Path) -> None:
    """In a child: read files one by one, and print a line for each before it is read and after."""
    mi.set_variant("llvm_ad_rgb")
    write_sound(name, folder)
    _bound_memory()
    for number in range(first, first + count):
        print(f"reading {number}", flush=True)
        kind, said = outcome(case(name, number, seed, folder)[0])
        print(json.dumps({"number": number, "kind": kind, "said": said[:LONGEST] if kind == "fault" else ""}), flush=True)


def _bound_memory() -> None:
    """Bound what this process may still allocate, where the system can (not on Windows)."""
    if sys.platform != "linux":
        return
    import resource

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY,) * 2)


def run_batch(name: str, first: int, count: int, seed: int) -> list[dict]:
    """Outcomes of a batch, read in a child; a file that ends the child is a fault, and the next child reads the rest."""
    found: list[dict] = []
    while len(found) < count:
        start = first + len(found)
        with tempfile.TemporaryDirectory() as folder:
            numbers = [str(n) for n in (start, count - len(found), seed)]
            command = [sys.executable, __file__, "--child", name, *numbers, folder]
            try:
                done = subprocess.run(command, **CHILD)
                lines, ended = done.stdout.splitlines(), f"ended with {done.returncode}: {done.stderr.strip()[-300:]}"
            except subprocess.TimeoutExpired as late:
                lines, ended = (late.stdout or b"").decode(errors="replace").splitlines(), f"hung for {BATCH_SECONDS} s"
        got = [json.loads(line) for line in lines if line.startswith("{")]
        found += got
        if len(found) < count:
            if not got and not any(line.startswith("reading") for line in lines):
                raise SystemExit(f"{name}: the sound file is not taken: {ended}")
            found.append({"number": first + len(found), "kind": "fault", "said": ended})
    return found


def main(argv: list[str] | None = None) -> int:
    """0 where every file was taken or refused in one sentence."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=20000, help="how many, over all formats")
    parser.add_argument("--seed", type=int, default=1, help="root of all mutations")
    parser.add_argument("--only", default="", help="formats, with commas between them")
    parser.add_argument("--keep", type=Path, help="folder for the files that showed a fault")
    args = parser.parse_args(argv)
    names = [name for name in (*FILES, *SETS) if not args.only or name in args.only.split(",")]
    faults = 0
    for place, name in enumerate(names):
        share = args.files // len(names) + (place < args.files % len(names))
        found = [one for k in range(0, share, BATCH) for one in run_batch(name, k, min(BATCH, share - k), args.seed)]
        kinds = Counter(one["kind"] for one in found)
        print(f"{name}: {share} files, {kinds['taken']} taken, {kinds['refused']} refused, {kinds['fault']} faults", flush=True)
        for one in found:
            if one["kind"] == "fault":
                faults += 1
                print(f"  {name} {one['number']} (seed {args.seed}): {one['said'][:300]}", flush=True)
                _keep(name, one["number"], args.seed, args.keep)
    print(f"{args.files} files, {faults} faults")
    return int(faults > 0)


def _keep(name: str, number: int, seed: int, folder: Path | None) -> None:
    if folder is None:
        return
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as made:
        mi.set_variant("llvm_ad_rgb")
        write_sound(name, Path(made))
        broken = case(name, number, seed, Path(made))[1]
        shutil.copy(broken, folder / f"{name.replace(' ', '_')}-{number}{broken.suffix}")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child_name, *child_numbers, child_folder = sys.argv[2:]
        read_batch(child_name, *map(int, child_numbers), Path(child_folder))
        sys.exit(0)
    sys.exit(main())
