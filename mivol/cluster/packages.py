"""Files and scenes for workers: packed by the owner, named by their content, unpacked once in each worker.

Conventions. A worker unpacks a file below a folder of its own at the absolute path that the file has at the owner, so relative
names inside of scenes and data sets stay valid. The scene of a worker must have the content hash of the owner's scene.
"""

from __future__ import annotations

import hashlib
import pickle
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_type_hints

import mitsuba as mi
import msgspec
import numpy as np

from mivol.cluster.pool import Pool
from mivol.cluster.workplace import Workplace
from mivol.errors import MivolError
from mivol.experiments.references import set_parameter
from mivol.files.fetch import PREFIX
from mivol.scene.load import LoadedScene, load_scene
from mivol.scene_graph import traverse


@dataclass(frozen=True)
class Bundle:
    """Compressed files by absolute path.

    Attributes:
        files: contents, compressed by zlib.
        digest: SHA-256 of paths and contents.
        size: bytes to send.
    """

    files: dict[str, bytes]
    digest: str
    size: int


def pack_files(paths: Iterable[Path]) -> Bundle:
    """Pack files, and all files below folders.

    Raises:
        MivolError: a missing file.
    """
    files, digest = {}, hashlib.sha256()
    found = {file.absolute() for path in paths for file in (path.rglob("*") if path.is_dir() else [path])}
    for path in sorted(Path(*_plain_parts(path)) for path in found if not path.is_dir()):
        try:
            content = path.read_bytes()
        except OSError as error:
            raise MivolError(f"{path} cannot be read for the workers ({error.strerror}): correct its name.") from None
        files[str(path)] = zlib.compress(content, 1)
        digest.update(str(path).encode() + b"\0" + hashlib.sha256(content).digest())
    return Bundle(files, digest.hexdigest(), sum(map(len, files.values())))


def _plain_parts(path: Path) -> list[str]:
    """Parts of an absolute path without "..", so that a worker writes below its own folder only."""
    parts: list[str] = []
    for part in path.parts:
        if part == "..":
            parts[1:] = parts[1:-1]
        else:
            parts.append(part)
    return parts


def unpack_files(files: Mapping[str, bytes], folder: Path) -> None:
    """Write the files of a bundle below a folder."""
    for name, content in files.items():
        target = place_below(folder, name)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(zlib.decompress(content))


def place_below(folder: Path, name: str) -> Path:
    """Where a worker has the file with this absolute path of the owner."""
    return folder.joinpath(*_plain_parts(Path(name))[1:])


def open_bundle(place: Workplace, digest: str) -> Path:
    """The folder of an unpacked bundle in this worker."""

    def unpack() -> Path:
        from distributed import get_worker

        folder = Path(get_worker().local_directory) / f"mivol-{digest[:16]}"
        unpack_files(place.kept[digest]["files"], folder)
        return folder

    return place.made(f"folder {digest}", unpack)


# -- Scenes ------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SceneSource:
    """A scene file as a worker can load it.

    Attributes:
        path: Mitsuba XML.
        defines: values of the XML's $parameters.
        folders: more folders with files of the scene.
        values: values of parameters to set after loading, by key.
    """

    path: Path
    defines: Mapping[str, Any] = field(default_factory=dict)
    folders: tuple[Path, ...] = ()
    values: Mapping[str, np.ndarray] = field(default_factory=dict)


def share_scene(pool: Pool, source: SceneSource, loaded: LoadedScene) -> str:
    """Register a scene as an input of work.

    Args:
        pool: the workers.
        source: the file behind ``loaded``.
        loaded: the scene as loaded by this process, before ``source.values`` are set.

    Raises:
        MivolError: a scene that is not from a file, or larger than half of the memory of a worker.
    """
    if loaded.kind != "file":
        raise MivolError(
            f"the scene is a {loaded.kind} in this process, which workers cannot load: give the path of its Mitsuba XML."
        )
    bundle = pack_files(loaded.files)
    digest = hashlib.sha256(bundle.digest.encode())
    values = zlib.compress(pickle.dumps(dict(sorted(source.values.items())), protocol=5), 1)
    digest.update(values)
    content = {
        "files": bundle.files,
        "path": str(source.path.absolute()),
        "defines": {key: _absolute_file(value, bundle) for key, value in source.defines.items()},
        "folders": [str(folder.absolute()) for folder in source.folders],
        "values": values,
        "hash": loaded.content_hash,
    }
    digest.update(msgspec.json.encode([content["path"], sorted(content["defines"].items()), content["folders"]]))
    size = bundle.size + sum(value.nbytes for value in source.values.values())
    return pool.share(digest.hexdigest(), content, size)


def _absolute_file(value: Any, bundle: Bundle) -> dict[str, Any]:
    """A define, with a mark if it is the absolute path of a packed file."""
    is_file = isinstance(value, str) and Path(value).is_absolute() and value in bundle.files
    return {"value": value, "is_file": is_file}


def open_scene(place: Workplace, digest: str) -> LoadedScene:
    """The scene of an input in this worker, loaded at the first call.

    Raises:
        MivolError: the scene differs from the owner's.
    """
    return place.made(f"scene {digest}", lambda: _load(place, digest))


def _load(place: Workplace, digest: str) -> LoadedScene:
    content, folder = place.kept[digest], open_bundle(place, digest)
    for name in content["folders"]:
        mi.file_resolver().append(str(place_below(folder, name)))
    defines = {
        key: str(place_below(folder, entry["value"])) if entry["is_file"] else entry["value"]
        for key, entry in content["defines"].items()
    }
    loaded = load_scene(place_below(folder, content["path"]), defines)
    if loaded.content_hash != content["hash"]:
        raise MivolError(
            f"the scene {content['path']} has other contents in a worker than here: a file was changed after the start, or the "
            "XML names a file by an absolute path, so name files relative to the XML."
        )
    params = traverse(loaded.scene)
    for key, value in pickle.loads(zlib.decompress(content["values"])).items():
        set_parameter(params, key, value)
    return loaded


def encode_sensor(scene: mi.Scene, sensor: int | Mapping[str, Any] | mi.Sensor) -> Any:
    """A sensor as plain Python: the number of a sensor of the scene, or a dict with matrices in place of transforms.

    Raises:
        MivolError: a sensor that the scene does not have.
    """
    if isinstance(sensor, mi.Sensor):
        number = next((number for number, own in enumerate(scene.sensors()) if own is sensor or own == sensor), None)
        if number is None:
            raise MivolError("a sensor is an object of this process, which workers do not have: give its number or a dict.")
        return number
    if isinstance(sensor, Mapping):
        return {key: encode_sensor(scene, value) for key, value in sensor.items()}
    if isinstance(sensor, mi.ScalarTransform4f):
        return {MATRIX: np.array(sensor.matrix, dtype=np.float64).tolist()}
    return sensor


MATRIX = "mivol matrix"
"""Key of an encoded transform."""


def decode_sensor(sensor: Any) -> Any:
    """The sensor behind :func:`encode_sensor`, for ``mitsuba.load_dict`` or as a number."""
    if not isinstance(sensor, Mapping):
        return sensor
    if MATRIX in sensor:
        return mi.ScalarTransform4f(np.array(sensor[MATRIX]))
    return {key: decode_sensor(value) for key, value in sensor.items()}


# -- Experiments -------------------------------------------------------------------------------------------------------------


def map_paths(settings: msgspec.Struct, change: Callable[[str, str], str], prefix: str = "") -> msgspec.Struct:
    """Settings with other paths.

    Args:
        settings: settings of an experiment.
        change: function of the dotted key and the path; called for each nonempty setting of unit "path", "output" excepted.
        prefix: dotted key of ``settings``.
    """
    hints, changed = get_type_hints(type(settings), include_extras=True), {}
    for name, hint in hints.items():
        value, key = getattr(settings, name, None), f"{prefix}{name}"
        unit = next((meta.extra["unit"] for meta in getattr(hint, "__metadata__", ()) if meta.extra), "")
        if isinstance(value, msgspec.Struct):
            changed[name] = map_paths(value, change, f"{key}.")
        elif isinstance(value, tuple) and any(isinstance(item, msgspec.Struct) for item in value):
            changed[name] = tuple(
                map_paths(item, change, f"{key}.{i}.") if isinstance(item, msgspec.Struct) else item
                for i, item in enumerate(value)
            )
        elif unit == "path" and key != "output" and value:
            changed[name] = change(key, value) if isinstance(value, str) else tuple(change(key, item) for item in value)
    return msgspec.structs.replace(settings, **changed)


def find_experiment_files(settings: msgspec.Struct, base: Path) -> list[Path]:
    """Find all files that an experiment reads, public data (``data:NAME``) excepted.

    Args:
        settings: settings of an experiment.
        base: folder from which relative paths start.

    Raises:
        MivolError: as :func:`mivol.scene.load.load_scene` for scenes.
    """
    files: list[Path] = []

    def note(key: str, name: str) -> str:
        path = (base / name).absolute()
        if name.startswith(PREFIX):
            return name
        if path.suffix.lower() == ".xml" and path.is_file():
            files.extend(load_scene(path, settings.scene.define if key == "scene.file" else {}).files)
        elif path.suffix.lower() in WITH_NEIGHBOURS and path.is_file():
            files.append(path.parent)
        elif any(letter in path.name for letter in "*?["):
            files.extend(path.parent.glob(path.name))
        else:
            files.append(path)
        return name

    map_paths(settings, note)
    return files


WITH_NEIGHBOURS = (".json", ".xtekct")
"""Files that name others beside them: cameras of photographs, and the settings of a scanner."""
