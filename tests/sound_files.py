"""A sound file of every format that is read, and what reads it: what ``.ci/fuzz_files.py`` breaks.

Here: :data:`FILES`, formats of one file; :data:`SETS`, what lies in several files, of which one at a time is broken.
"""

from __future__ import annotations

import gzip
import json
import struct
from collections.abc import Callable
from pathlib import Path

import h5py
import laspy
import numpy as np
import scipy.io
import tifffile
from beamline_files import write_named, write_nxtomo
from dicom_series import write_frames, write_series
from dicom_views import write_angiography
from gaussian_sets import compressed_bytes, in_buckets, inria_bytes, ksplat_bytes, random_gaussians, splat_bytes, spz_bytes
from netcdf_files import write_classic, write_hdf5
from photo_sets import write_blender, write_colmap, write_transforms
from PIL import Image
from volume_files import les, meta_head, mha, nifti, nrrd, nrrd_head, numbered, packed, pbrt, vol, vti, vtk

import mivol
from mivol import config
from mivol.experiments.found_scan import draft_scan
from mivol.fields.field_files import write_field
from mivol.fields.sky import read_sky
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import read_columns, read_exr, read_projections, read_stack, write_exr, write_png
from mivol.files.image_stack import read_header_angles
from mivol.files.mesh import Mesh, read_ply, write_mesh
from mivol.files.nikon import read_nikon, read_nikon_angles, read_nikon_transmission
from mivol.files.npy import read_archive
from mivol.files.pbrt_scene import read_pbrt_scene
from mivol.photos.photo_file import read_mask, read_photo
from mivol.points.cloud import PointCloud, read_points, write_points
from mivol.points.gaussian_files import read_gaussians, write_gaussians
from mivol.report import record
from mivol.report.page import write_page
from mivol.validate.reference_file import ReferenceResult, read_checkpoint, read_reference, write_checkpoint, write_reference
from mivol.validate.statistics import Moments
from mivol.validate.trust import Doubt

ROOT = Path(__file__).resolve().parents[1]
CONFORMANCE = ROOT / "tests" / "conformance"

Read = Callable[[Path], object]
Write = Callable[[Path], object]


def _bytes(data: bytes) -> Write:
    return lambda path: path.write_bytes(data)


def _copy(name: str) -> Write:
    return lambda path: path.write_bytes((ROOT / name).read_bytes())


# -- Writers ---------------------------------------------------------------------------------------------------------------


def _projections(path: Path) -> None:
    with h5py.File(path, "w") as file:
        rng = np.random.default_rng(0)
        for name, shape in (("data", (4, 3, 5)), ("data_white", (2, 3, 5)), ("data_dark", (2, 3, 5))):
            file[f"exchange/{name}"] = rng.integers(1, 999, shape).astype(np.uint16)
        file["exchange/theta"] = np.linspace(0, 180, 4, endpoint=False)


def _dicom(path: Path) -> None:
    write_frames(path, numbered()[..., 0].astype("i2"), "axial", [1, 0], [1.0, 2.0])


def _dicom_views(path: Path) -> None:
    write_angiography(path, np.arange(3) * 40.0, (3, 5))


def _series(folder: Path) -> None:
    write_series(folder, numbered()[..., 0].astype("i2"), names=["a.dcm", "b.dcm"])


def _netcdf(write: Callable) -> Write:
    axes = {name: ((name,), np.arange(n) + 0.5, {"units": "m"}) for name, n in zip("zyx", (2, 3, 4), strict=True)}
    return lambda path: write(path, {**axes, "ql": (("time", "z", "y", "x"), numbered()[None, ..., 0], {"scale_factor": 2.0})})


def _matlab(path: Path) -> None:
    scipy.io.savemat(path, {"density": numbered()[..., 0], "name": "a"}, do_compression=True)


def _matlab_hdf5(path: Path) -> None:
    _hdf5(path)
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + path.read_bytes())


def _tiff(compression: str | None) -> Write:
    more = {"compression": compression, "imagej": compression is None}
    return lambda path: tifffile.imwrite(path, numbered(5, 6, 7)[..., 0], photometric="minisblack", **more)


NAMES = {"data": "scan/camera/frames", "flats": "before/reference", "darks": "before/background", "angles": "scan/stage"}
"""Datasets of ``write_named``."""


def _edf(path: Path) -> None:
    from fabio.edfimage import EdfImage

    EdfImage(data=numbered(2, 6, 7)[0, ..., 0], header={"k": "1"}).write(str(path))


def his_bytes(frames: np.ndarray, comment: bytes = b"exposure=1") -> bytes:
    """A sequence (n, rows, columns) of uint16 of a Hamamatsu camera."""
    head = struct.pack("<2s6H", b"IM", len(comment), frames.shape[2], frames.shape[1], 0, 0, 2).ljust(64, b"\0") + comment
    return b"".join(head + frame.astype("<u2").tobytes() for frame in frames)


def _tilt_series(folder: Path) -> None:
    values = np.ones((3, 4, 20, 1), np.float32)
    values[:, :, 7:13] = 0.5
    mivol.write_volume(folder / "a.mrc", values)
    (folder / "a.mrc.mdoc").write_text("".join(f"[ZValue = {k}]\nTiltAngle = {10 * k}\n\n" for k in range(3)))


def _views(folder: Path) -> None:
    for k in range(3):
        tifffile.imwrite(folder / f"view_{k}.tif", np.full((4, 20), 500 + k, "u2"))
        tifffile.imwrite(folder / f"flat_{k}.tif", np.full((4, 20), 1000 + k, "u2"))
    (folder / "angles.txt").write_text("0\n60\n120\n")


def _zarr(folder: Path) -> None:
    folder.rmdir()
    mivol.write_volume(folder.with_suffix(".zarr"), numbered())
    folder.with_suffix(".zarr").rename(folder)


def _zarr_3(folder: Path) -> None:
    import tensorstore

    store = {"driver": "zarr3", "kvstore": {"driver": "file", "path": str(folder)}}
    tensorstore.open(store, create=True, dtype="float32", shape=(2, 3, 4)).result()[...] = numbered()[..., 0]


def _raw_toml(folder: Path) -> None:
    (folder / "a.raw").write_bytes(_raw())
    (folder / "a.toml").write_text('shape = [2, 3, 4]\ndtype = "float32"\nspacing = [1, 2, 3]\nunit = "mm"\n')


def _edf_views(folder: Path) -> None:
    """The angles are in the headers."""
    from fabio.edfimage import EdfImage

    for k in range(3):
        head = {"motor_mne": "sx srot", "motor_pos": f"1.5 {60 * k}"}
        EdfImage(data=np.full((4, 20), 500 + k, "u2"), header=head).write(str(folder / f"view_{k}.edf"))
    EdfImage(data=np.full((4, 20), 1000, "u2")).write(str(folder / "flat.edf"))


def _slices(folder: Path) -> None:
    for k, values in enumerate(numbered()[..., 0]):
        tifffile.imwrite(folder / f"s{k}.tif", values)


def _hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["density"] = numbered()[..., 0]


def _picture(path: Path) -> None:
    Image.fromarray(np.random.default_rng(1).integers(0, 256, (8, 12, 4), np.uint8)).save(path)


def _field(path: Path) -> None:
    rng = np.random.default_rng(2)
    keep = rng.random((3, 4, 5)) < 0.5
    values = rng.random((3, 4, 5)), rng.normal(0, 1, (3, 4, 5, 4, 3))
    mivol.write_field(path, SphericalGrid.from_dense(*values, np.eye(4), keep))


def _svox2(path: Path) -> None:
    rng = np.random.default_rng(3)
    write_field(path, SphericalGrid.from_dense(rng.random((3, 4, 5)), rng.normal(0, 1, (3, 4, 5, 4, 3)), np.eye(4)))


def _mesh(path: Path) -> None:
    points, faces = np.eye(4, 3), np.array([[0, 1, 2], [0, 1, 3]])
    write_mesh(path, Mesh(points, faces, colours=np.full((4, 3), 0.5)))


def _checkpoint(path: Path) -> None:
    rng = np.random.default_rng(4)
    np.savez(path, density=rng.random((3, 4)), state=np.array(json.dumps({"iteration": 3})))


def _volume(path: Path) -> None:
    mivol.write_volume(path, numbered())


def _of_openvdb(path: Path) -> None:
    """A file of OpenVDB with Blosc, tiles, half floats and a level set."""
    path.write_bytes(gzip.decompress((CONFORMANCE / "openvdb_10.vdb.gz").read_bytes()))


def _packed_nvdb(path: Path) -> None:
    """The last grid of a file of NanoVDB, compressed by zip."""
    data = gzip.decompress((CONFORMANCE / "nanovdb_32.nvdb.gz").read_bytes())
    path.write_bytes(data[data.rindex(b"NanoVDB0") :])


def _exr(path: Path) -> None:
    write_exr(path, {"": np.random.default_rng(5).random((6, 12, 3)).astype(np.float32)})


def _cloud(path: Path) -> None:
    rng = np.random.default_rng(6)
    write_points(path, PointCloud(rng.random((9, 3)), rng.random((9, 3))))


def _las(path: Path) -> None:
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.scales = np.full(3, 0.001)
    one = laspy.LasData(header)
    one.x, one.y, one.z = np.random.default_rng(7).random((3, 9))
    one.red = one.green = one.blue = np.arange(9) * 1000
    one.write(path)


SCENE = b"""<scene version="3.0.0">
    <default name="spp" value="4"/>
    <integrator type="mivol"><integer name="max_depth" value="4"/></integrator>
    <emitter type="constant"><rgb name="radiance" value="0.5, 0.6, 0.7"/></emitter>
    <sensor type="perspective">
        <float name="fov" value="35"/>
        <transform name="to_world"><lookat origin="0, 1, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/></film>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
    </sensor>
    <shape type="cube" id="cube">
        <bsdf type="null"/>
        <medium type="homogeneous" name="interior">
            <rgb name="albedo" value="0.9, 0.8, 0.7"/><float name="sigma_t" value="1.5"/>
            <phase type="hg"><float name="g" value="0.3"/></phase>
        </medium>
    </shape>
</scene>"""

PBRT_SCENE = b"""LookAt 0 0 -4  0 0 0  0 1 0 # the eye
Camera "perspective" "float fov" [ 40 ] Film "rgb" "integer xresolution" 8
WorldBegin LightSource "infinite" "blackbody L" 5000 "float scale" [ 2 ]
AttributeBegin Translate 0 1 0 Rotate 90 1 0 0
MakeNamedMedium "m" "string type" "uniformgrid" "integer nx" 2 "spectrum sigma_s" [ 300 1 800 2 ] "float density" [ 1 2 ]
MediumInterface "m" "" Material "interface" Shape "sphere" "float radius" 3 AttributeEnd
Material "diffuse" "rgb reflectance" [ .1 .2 .3 ] Shape "trianglemesh" "point3 P" [ 0 0 0 1 0 0 0 1 0 ] "bool a" true
"""

IDENTITY = {"scene": "0" * 64, "integrator": "volpath", "max_depth": 2, "channels_alone": False, "pass_spp": 16}


def _reference(path: Path) -> None:
    image = np.random.default_rng(8).random((4, 5, 3))
    doubts = (Doubt("phase", "Mitsuba samples it with an error of 0.1 %."),)
    write_reference(ReferenceResult(image, image**2, 4, 64, IDENTITY, path, doubts))


def _state(path: Path) -> None:
    write_checkpoint(
        path.with_suffix("").with_suffix(".exr"), IDENTITY, Moments(3, np.ones((4, 5, 3)), np.ones((4, 5, 3))), 1.0
    )


def _detached_nrrd(folder: Path) -> None:
    (folder / "a.nhdr").write_text(nrrd_head(numbered(), **{"data file": "a.raw"}))
    (folder / "a.raw").write_bytes(_raw())


def _detached_metaimage(folder: Path) -> None:
    (folder / "a.mhd").write_bytes(meta_head(numbered(), data="a.raw"))
    (folder / "a.raw").write_bytes(_raw())


def _raw() -> bytes:
    return packed(list(range(24)), "f4")


def _nikon(folder: Path) -> None:
    settings = {
        **{"Name": "bead", "InputSeparator": "_", "SrcToObject": 20, "SrcToDetector": 50, "DetectorPixelsX": 5},
        **{"DetectorPixelsY": 4, "DetectorPixelSizeX": 0.5, "DetectorPixelSizeY": 0.6, "WhiteLevel": 60000},
        **{"Projections": 3, "InitialAngle": 180, "AngularStep": 120},
    }
    lines = [f"{key}={value}" for key, value in settings.items()]
    (folder / "bead.xtekct").write_text("\n".join(["[XTekCT]", *lines, ""]))
    (folder / "_ctdata.txt").write_text("Projs\tFrames\n3\t1\nProjection\tAngle\n1\t180.0\n2\t300.0\n3\t420.0\n")
    for number in range(1, 4):
        Image.fromarray(np.full((4, 5), 1000 * number, np.uint16)).save(folder / f"bead_{number:04d}.tif")


def _run(folder: Path) -> None:
    """A run folder with one picture, one volume and a curve."""
    write_png(folder / "a.png", np.full((4, 4, 3), 0.5, np.float32))
    mivol.write_volume(folder / "a.vol", numbered())
    shown = {
        "images": [record.Image(path="a.png", role="picture")],
        "volumes": [record.Volume(path="a.vol", role="reconstruction")],
    }
    record.write_record(record.RunRecord.new("a run", method="adam", config={"fit": {"iterations": 4}}, **shown), folder)
    for iteration in range(3):
        record.append_metrics(folder, iteration, 0.1 * iteration, loss=1 / (1 + iteration))


# -- Readers ---------------------------------------------------------------------------------------------------------------


def _read_nikon(folder: Path) -> object:
    scan = read_nikon(folder / "bead.xtekct")
    return read_nikon_angles(folder / "_ctdata.txt", len(scan.angles)), read_nikon_transmission(scan)


def _read_picture(path: Path) -> object:
    return read_photo(path, "srgb")


def _of(values: np.ndarray) -> list[tuple]:
    z, y, x, _ = values.shape
    return [(i, j, k, float(values[k, j, i, 0]), 9.0) for k in range(z) for j in range(y) for i in range(x)]


PACKAGES = {"edf": "fabio", "folder of edf": "fabio", "zarr": "tensorstore", "zarr 3": "tensorstore"}
"""Package of ``mivol[lab]`` without which a format is neither written nor read, by key of :data:`FILES` and :data:`SETS`."""

FILES: dict[str, tuple[str, Write, Read]] = {
    "vol": (".vol", _bytes(vol(numbered())), mivol.read_volume),
    "npy": (".npy", _volume, mivol.read_volume),
    "npz": (".npz", _volume, mivol.read_volume),
    "nrrd": (".nrrd", _bytes(nrrd(numbered())), mivol.read_volume),
    "nrrd gzip": (".nrrd", _bytes(nrrd(numbered(), encoding="gzip")), mivol.read_volume),
    "metaimage": (".mha", _bytes(mha(numbered())), mivol.read_volume),
    "nifti": (".nii", _bytes(nifti(numbered())), mivol.read_volume),
    "nifti gzip": (".nii.gz", _bytes(gzip.compress(nifti(numbered()))), mivol.read_volume),
    "vti": (".vti", _bytes(vti(numbered())), mivol.read_volume),
    "vtk": (".vtk", _bytes(vtk(numbered())), mivol.read_volume),
    "vtk text": (".vtk", _bytes(vtk(numbered(), binary=False)), mivol.read_volume),
    "pbrt": (".pbrt", _bytes(pbrt(numbered())), mivol.read_volume),
    "vdb": (".vdb", _volume, mivol.read_volume),
    "vdb sparse": (".vdb", _volume, mivol.files.read_sparse_volume),
    "vdb blosc": (".vdb", _of_openvdb, lambda path: mivol.files.read_sparse_volume(path, "density")),
    "vdb level set": (".vdb", _of_openvdb, lambda path: mivol.read_volume(path, "ball")),
    "nvdb": (".nvdb", _volume, mivol.read_volume),
    "nvdb packed": (".nvdb", _packed_nvdb, mivol.read_volume),
    "pbrt scene": (".pbrt", _bytes(PBRT_SCENE), read_pbrt_scene),
    "les": (".txt", _bytes(les(_of(numbered()))), mivol.read_volume),
    "matlab": (".mat", _matlab, mivol.read_volume),
    "matlab hdf5": (".mat", _matlab_hdf5, mivol.read_volume),
    "netcdf": (".nc", _netcdf(write_classic), mivol.read_volume),
    "netcdf-4": (".nc", _netcdf(write_hdf5), mivol.read_volume),
    "raw": (".raw", lambda path: path.write_bytes(_raw()), lambda path: mivol.read_volume(path, shape=(2, 3, 4), dtype="f4")),
    "tiff": (".tif", _tiff(None), mivol.read_volume),
    "tiff zlib": (".tif", _tiff("zlib"), mivol.read_volume),
    "tiff ours": (".tif", _volume, mivol.read_volume),
    "mrc": (".mrc", _volume, mivol.read_volume),
    "edf": (".edf", _edf, read_stack),
    "his": (".his", _bytes(his_bytes(np.arange(84).reshape(2, 6, 7))), read_stack),
    "hdf5 by names": (".h5", write_named, lambda path: read_projections(path, names=NAMES)),
    "dicom": (".dcm", _dicom, mivol.read_volume),
    "dicom views": (".dcm", _dicom_views, lambda path: (draft_scan(path), read_stack(path))),
    "hdf5": (".h5", _hdf5, mivol.read_volume),
    "projections": (".h5", _projections, read_projections),
    "stack": (".tif", lambda path: Image.fromarray(np.eye(8, 9, dtype=np.float32)).save(path), read_stack),
    "exr": (".exr", _exr, read_exr),
    "sky": (".exr", _exr, read_sky),
    "png": (".png", _picture, _read_picture),
    "jpeg": (".jpg", lambda path: Image.fromarray(np.eye(9, 8, dtype=np.uint8) * 200).save(path), _read_picture),
    "radiance": (".exr", _exr, _read_picture),
    "mask": (".png", _picture, read_mask),
    "field": (".npz", _field, mivol.read_field),
    "svox2": (".svox2.npz", _svox2, mivol.read_field),
    "mesh": (".ply", _mesh, read_ply),
    "columns": (".txt", _bytes(b"# a table\n1 2 3\n4.5 -6 7e-3\n8 9 10\n"), lambda path: read_columns(path, 3)),
    "checkpoint": (".npz", _checkpoint, read_archive),
    "toml": (".toml", _copy("scenes/demo/fit.toml"), config.load),
    "toml scan": (".toml", _copy("scenes/shepp_logan/fit.toml"), config.load),
    "gaussians": (".ply", _bytes(inria_bytes(random_gaussians(5, 1))), read_gaussians),
    "compressed gaussians": (".ply", _bytes(compressed_bytes(random_gaussians(5, 0))), read_gaussians),
    "spz 2": (".spz", _bytes(spz_bytes(random_gaussians(5, 1), 2)), read_gaussians),
    "spz 4": (".spz", _bytes(spz_bytes(random_gaussians(5, 1), 4)), read_gaussians),
    "splat": (".splat", _bytes(splat_bytes(random_gaussians(5, 0))), read_gaussians),
    "sog": (".sog", lambda path: write_gaussians(path, random_gaussians(5, 1)), read_gaussians),
    "glb": (".glb", lambda path: write_gaussians(path, random_gaussians(5, 1)), read_gaussians),
    "ksplat": (".ksplat", _bytes(ksplat_bytes([in_buckets(random_gaussians(5, 1))], 1)), read_gaussians),
    "points": (".ply", _cloud, read_points),
    "points npy": (".npy", _cloud, read_points),
    "las": (".las", _las, read_points),
    "reference": (".exr", _reference, read_reference),
    "reference state": (".state.npz", _state, read_checkpoint),
    "scene": (".xml", _bytes(SCENE), mivol.load_scene),
}
"""Name: suffix, what writes a sound file, what reads it."""

SETS: dict[str, tuple[Write, tuple[str, ...], Read]] = {
    "nrrd detached": (_detached_nrrd, ("a.nhdr", "a.raw"), lambda folder: mivol.read_volume(folder / "a.nhdr")),
    "metaimage detached": (_detached_metaimage, ("a.mhd", "a.raw"), lambda folder: mivol.read_volume(folder / "a.mhd")),
    "raw by a header": (_detached_metaimage, ("a.mhd", "a.raw"), lambda folder: mivol.read_volume(folder / "a.raw")),
    "raw by a toml": (_raw_toml, ("a.toml", "a.raw"), lambda folder: mivol.read_volume(folder / "a.raw")),
    "folder of edf": (
        _edf_views,
        ("view_0.edf", "view_2.edf", "flat.edf"),
        lambda folder: (draft_scan(folder), read_stack(folder / "view_*.edf"), read_header_angles(folder / "view_*.edf")),
    ),
    "nxtomo": (
        lambda folder: write_nxtomo(folder / "a.nxs"),
        ("a.nxs", "a_frames.h5"),
        lambda folder: read_projections(folder / "a.nxs"),
    ),
    "tilt series": (_tilt_series, ("a.mrc", "a.mrc.mdoc"), lambda folder: draft_scan(folder / "a.mrc")),
    "folder of views": (
        _views,
        ("view_0.tif", "view_2.tif", "flat_0.tif", "angles.txt"),
        lambda folder: (draft_scan(folder), read_stack(folder / "view_*.tif"), read_stack(folder / "flat_*.tif")),
    ),
    "zarr": (_zarr, (".zattrs", "0/.zarray", "0/0/0/0"), mivol.read_volume),
    "zarr 3": (_zarr_3, ("zarr.json", "c/0/0/0"), mivol.read_volume),
    "tiff slices": (_slices, ("s0.tif", "s1.tif"), mivol.read_volume),
    "dicom series": (_series, ("a.dcm", "b.dcm"), mivol.read_volume),
    "nikon": (_nikon, ("bead.xtekct", "_ctdata.txt", "bead_0002.tif"), _read_nikon),
    "run": (_run, ("run.json", "metrics.jsonl", "a.png", "a.vol"), write_page),
    "blender": (
        lambda folder: write_blender(folder, alpha=False),
        ("transforms_train.json", "transforms_test.json", "train/r_0.png"),
        mivol.load_photos,
    ),
    "transforms": (
        lambda folder: write_transforms(folder, {"fl_x": 10.0, "w": 12, "h": 8}),
        ("transforms.json",),
        mivol.load_photos,
    ),
    "colmap": (write_colmap, ("sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"), mivol.load_photos),
    "colmap text": (
        lambda folder: write_colmap(folder, encoding="txt"),
        ("sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt"),
        mivol.load_photos,
    ),
}
"""Name: what writes a sound set, the files in it that are broken, one at a time, and what reads it."""
