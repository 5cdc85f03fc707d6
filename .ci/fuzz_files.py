"""Does every broken file end in one sentence? Mutate sound files of all formats by a seed, and read them.

A reader may take a broken file (a changed voxel is a voxel) or refuse it by a MivolError of one line. Anything else is a
fault: another exception, many lines or more than 1000 characters, a crash, a hang. Files are read in child processes with
a bound on memory and time, so that a crash names its file.

    .ci/fuzz_files.py                        20,000 files: about an hour of one core
    .ci/fuzz_files.py --files 300 --seed 7   fewer
    .ci/fuzz_files.py --only nrrd,colmap     of some formats
    .ci/fuzz_files.py --keep broken          keep the files that showed a fault there
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

import mitsuba as mi  # noqa: E402
import numpy as np  # noqa: E402
from sound_files import FILES, SETS  # noqa: E402

BATCH = 700
"""Files a child process reads."""

BATCH_SECONDS = 300
"""Sound files of these sizes take milliseconds: a batch that takes so long hangs."""

MEMORY = 6 << 30
"""Address space of a child beyond what it has when it begins: Mitsuba alone maps gigabytes."""

LONGEST = 1000
"""Characters of a sentence: of what it found, a refusal quotes no more than 300."""

CHILD = {"capture_output": True, "text": True, "errors": "replace", "timeout": BATCH_SECONDS, "check": False}

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
    _, files, read = SETS[name]
    whole, copy = folder / "sound", folder / "broken"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(whole, copy)
    broken = copy / files[int(rng.integers(len(files)))]
    broken.write_bytes(mutate(broken.read_bytes(), rng))
    return (lambda: read(copy)), broken


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
    write, _, read = SETS[name]
    write(whole)
    read(whole)


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
