"""A small real reconstruction, written as a run folder: what the page is tested and looked at with.

A volume of seeded blobs is seen from a ring of pinhole views against a white background; its transmittance images get
Gaussian noise; conjugate gradients on the log-transmittance of the fitted views give the reconstruction. The projector
is a sparse matrix of trilinear weights at fixed steps: slow, obvious, and not mivol's.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.sparse import csr_matrix

from mivol.files import write_exr, write_volume
from mivol.report.record import Image, PlanLine, RunRecord, Volume, append_metrics, write_record


def blobs(n: int, rng: np.random.Generator) -> np.ndarray:
    """Extinction [1/length] of six blobs in the unit cube, (n, n, n), largest value 12."""
    axis = (np.arange(n) + 0.5) / n
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    grid = np.zeros((n, n, n))
    for centre, radius in zip(rng.uniform(0.28, 0.72, (6, 3)), rng.uniform(0.05, 0.14, 6), strict=True):
        r2 = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2
        grid += np.exp(-0.5 * r2 / radius**2)
    return 12 * grid / grid.max()


def pinhole(angle: float, size: int, n: int, steps: int) -> csr_matrix:
    """Optical depth of size x size pixels through an n^3 grid of the unit cube, camera at distance 2.4 from its middle."""
    eye = 0.5 + 2.4 * np.array([np.cos(angle), np.sin(angle), 0.25])
    forward = (0.5 - eye) / np.linalg.norm(0.5 - eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    u = (np.arange(size) + 0.5) / size * 2 - 1
    d = forward + 0.36 * (u[None, :, None] * right - u[:, None, None] * up)
    d = (d / np.linalg.norm(d, axis=2, keepdims=True)).reshape(-1, 3)
    t = 1.4 + 2.0 * (np.arange(steps) + 0.5) / steps
    q = ((eye + t[:, None] * d[:, None, :]) * n - 0.5).reshape(-1, 3)
    ray = np.repeat(np.arange(len(d)), steps)
    inside = np.all((q >= -0.5) & (q <= n - 0.5), axis=1)
    q, ray = q[inside], ray[inside]
    low = np.floor(q).astype(int)
    f = q - low
    rows, columns, weights = [], [], []
    for corner in np.ndindex(2, 2, 2):
        node = np.clip(low + corner, 0, n - 1)
        columns.append((node[:, 2] * n + node[:, 1]) * n + node[:, 0])
        weights.append(np.prod(np.where(corner, f, 1 - f), axis=1) * 2.0 / steps)
        rows.append(ray)
    shape = (size * size, n**3)
    return csr_matrix((np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape=shape)


def write_run(folder: Path, *, n: int = 12, size: int = 16, fitted: int = 8, held_out: int = 2, steps: int = 12) -> Path:
    """Reconstruct and write everything that ``mivol optimize`` would; the folder."""
    rng = np.random.default_rng(3)
    truth, noise = blobs(n, rng), 0.005
    for name in ("images", "volumes"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    angles = np.pi * np.arange(fitted + held_out) * (3 - 5**0.5)
    projectors = [pinhole(angle, size, n, 3 * n) for angle in angles]
    clean = [np.exp(-(matrix @ truth.ravel())) for matrix in projectors]
    seen = [image + noise * rng.normal(size=image.shape) for image in clean]
    x, rows = _conjugate_gradients(projectors[:fitted], seen[:fitted], truth.ravel(), noise, steps)
    for row in rows:
        append_metrics(folder, **row)
    grid = x.reshape(n, n, n)
    images = []
    for i in range(fitted, fitted + held_out):
        view = f"view {i + 1}"
        render = np.exp(-(projectors[i] @ x))
        for role, image in {"reference": seen[i], "render": render, "standard error": np.full_like(render, noise)}.items():
            path = f"images/view_{i + 1}_{role.replace(' ', '_')}.exr"
            write_exr(folder / path, {"Y": image.reshape(size, size)})
            images.append(Image(path=path, role=role, view=view, held_out=True, quantity="transmittance"))
    for name, values in {"truth": truth, "sigma_t": grid}.items():
        write_volume(folder / f"volumes/{name}.npz", values[..., None].astype(np.float32))
    record = RunRecord.new(
        "Blobs",
        method=f"Absorption only: conjugate gradients on the log-transmittance of {fitted} views, sigma_t of {n}³ voxels.",
        status="finished",
        command="mivol optimize scenes/blobs/fit.toml",
        config={
            "scene": "scene.xml",
            "views": {"fitted": fitted, "held_out": held_out, "size": [size, size]},
            "solver": {"name": "cg", "iterations": steps, "non_negative": True},
        },
        seeds={"volume": 3, "noise": 3},
        plan=[
            PlanLine(choice="Absorption along each ray", reason="The albedo is 0 everywhere: light is lost, never turned."),
            PlanLine(choice="One channel", reason="The extinction is grey, so the three channels would be the same."),
            PlanLine(choice="Conjugate gradients on logarithms", reason="Optical depth is linear in sigma_t along a thin ray."),
        ],
        timings={"references": 0.41, "set-up": 0.18, "solver": 1.9, "held-out views": 0.12, "report": 0.3},
        results={"nrmse": rows[-1]["nrmse"], "iterations": steps, "views": fitted},
        images=images,
        volumes=[Volume(path="volumes/truth.npz", role="truth"), Volume(path="volumes/sigma_t.npz", role="reconstruction")],
        notes=["The references carry Gaussian noise of 0.005; no fit can do better on them than 46 dB."],
        citations=["mitsuba3", "drjit", "kak_1988", "hestenes_1952"],
    )
    write_record(record, folder)
    return folder


def _conjugate_gradients(matrices, images, truth, noise, steps):
    """CGLS on the log of the images, weights 0 where they are below 3 sigma; x is clipped at 0 at the end."""
    weight = [np.sqrt(np.maximum(image, 0)) * (image > 3 * noise) for image in images]
    y = [-np.log(np.maximum(image, noise)) for image in images]
    x = np.zeros(matrices[0].shape[1])
    residual = [w * v for w, v in zip(weight, y, strict=True)]
    first = np.sqrt(sum(np.sum(r * r) for r in residual))
    s = sum(m.T @ (w * r) for m, w, r in zip(matrices, weight, residual, strict=True))
    p, gamma, rows = s, s @ s, []
    for iteration in range(1, steps + 1):
        q = [w * (m @ p) for m, w in zip(matrices, weight, strict=True)]
        alpha = gamma / sum(np.sum(v * v) for v in q)
        x = x + alpha * p
        residual = [r - alpha * v for r, v in zip(residual, q, strict=True)]
        s = sum(m.T @ (w * r) for m, w, r in zip(matrices, weight, residual, strict=True))
        p, gamma = s + (s @ s) / gamma * p, s @ s
        shown = np.maximum(x, 0)
        rows.append(
            {
                "iteration": iteration,
                "seconds": 0.15 * iteration,
                "residual": float(np.sqrt(sum(np.sum(r * r) for r in residual)) / first),
                "nrmse": float(np.linalg.norm(shown - truth) / np.linalg.norm(truth)),
            }
        )
    return np.maximum(x, 0), rows
