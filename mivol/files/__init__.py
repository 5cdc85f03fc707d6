"""Files of volumes, projections and images: readers that check headers, writers that never leave half a file.

The room needs no Mitsuba. Grids are float32 (Z, Y, X, C) at voxel centres of the unit cube; ``to_world`` places the cube.
"""

from __future__ import annotations

from mivol.files.atomic import whole_file, write_whole, write_whole_bytes, write_whole_text
from mivol.files.formats import (
    FORMATS,
    FRAMES,
    WRITERS,
    is_sparse_file,
    read_sparse_volume,
    read_volume,
    write_grids,
    write_volume,
)
from mivol.files.image_files import decode_srgb, encode_srgb, read_exr, read_exr_header, stack_layers, write_exr, write_png
from mivol.files.image_stack import read_slices, read_stack
from mivol.files.scan_hdf5 import ProjectionData, read_projections
from mivol.files.source import read_columns
from mivol.files.volume import (
    SparseVolumeData,
    VolumeData,
    check_bricks,
    check_frame,
    check_volume,
    frame_from_box,
    frame_from_steps,
    to_space,
)

__all__ = [
    "FORMATS",
    "FRAMES",
    "WRITERS",
    "ProjectionData",
    "SparseVolumeData",
    "VolumeData",
    "check_bricks",
    "check_frame",
    "check_volume",
    "decode_srgb",
    "encode_srgb",
    "frame_from_box",
    "frame_from_steps",
    "is_sparse_file",
    "read_columns",
    "read_exr",
    "read_exr_header",
    "read_projections",
    "read_slices",
    "read_sparse_volume",
    "read_stack",
    "read_volume",
    "stack_layers",
    "to_space",
    "whole_file",
    "write_exr",
    "write_grids",
    "write_png",
    "write_volume",
    "write_whole",
    "write_whole_bytes",
    "write_whole_text",
]
