"""How much work the bench of optical depths does."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["FULL", "QUICK", "Size"]


@dataclass(frozen=True)
class Size:
    """How much work is done.

    Attributes:
        name: for the JSON.
        rounds: warm calls of each contestant.
        walk_side, image_side, grid_side, peer_side: of square pictures [pixels]; rays are their squares.
        image_spp: samples per pixel of the renders.
        exact_pixels, exact_rays: how many of them are compared with float64.
        accuracy_res: voxels along an edge of the grids whose errors are measured.
        memory_res, memory_sides: voxels along an edge, and pictures that one gradient step each is made of.
        ct_res, sparse_res: voxels along an edge of the CT and of the threads.
        peer_rounds, peer_spp, volpath_spp, march_steps: settings of the peers.
    """

    name: str = "full"
    rounds: int = 7
    walk_side: int = 1024
    image_side: int = 256
    image_spp: int = 16
    exact_pixels: int = 192
    exact_rays: int = 4096
    accuracy_res: tuple[int, ...] = (64, 256)
    memory_res: tuple[int, ...] = (16, 64)
    memory_sides: tuple[int, ...] = (256, 512, 1024)
    grid_side: int = 512
    ct_res: int = 256
    sparse_res: int = 512
    peer_rounds: int = 3
    peer_side: int = 512
    peer_spp: tuple[int, ...] = (1, 4, 16, 64)
    volpath_spp: tuple[int, ...] = (1, 4, 16)
    march_steps: tuple[int, ...] = (16, 32, 64, 128, 256, 512, 1024)


FULL = Size()
QUICK = Size(
    name="quick",
    rounds=3,
    walk_side=256,
    image_side=64,
    image_spp=4,
    exact_pixels=32,
    exact_rays=1024,
    accuracy_res=(64,),
    memory_sides=(64, 128, 256),
    grid_side=128,
    ct_res=64,
    sparse_res=128,
    peer_side=64,
    peer_spp=(1, 4),
    volpath_spp=(1, 4),
    march_steps=(16, 64, 256),
)
