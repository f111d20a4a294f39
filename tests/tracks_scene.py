"""A textured plane and its cameras, rendered through any COLMAP camera model."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from protomark.geometry.camera import Camera

PINHOLE = Camera("PINHOLE", 320, 240, (300.0, 300.0, 160.0, 120.0))
# Wide and strongly bent, with a coefficient above 1, which COLMAP by default takes for nonsense.
DISTORTED = Camera(
    "FULL_OPENCV",
    320,
    240,
    (260.0, 258.0, 159.0, 127.0, 0.26, -0.95, -0.005, 0.003, 1.16, 0.0, 0.0, 0.0),
)


def texture(size: int = 900, seed: int = 3) -> NDArray[np.uint8]:
    """Blocks of random grey on four scales, with many corners."""
    rng = np.random.default_rng(seed)
    image = np.zeros((size, size), np.float32)
    for cells, weight in ((12, 0.3), (30, 0.3), (75, 0.3), (180, 0.1)):
        grid = rng.uniform(0, 255, (cells, cells)).astype(np.float32)
        image += weight * cv2.resize(grid, (size, size), interpolation=cv2.INTER_NEAREST)
    return cv2.GaussianBlur(image, (0, 0), 1.2).clip(0, 255).astype(np.uint8)


def poses(count: int) -> NDArray[np.float64]:
    """(count, 3, 4) cam_from_world on an arc at z = -2, all facing the plane z = 0."""
    out = []
    for t in np.linspace(-0.45, 0.45, count):
        center = np.array([2 * np.sin(t), 0.15 * np.cos(7 * t), -2 * np.cos(t)])
        forward = -center / np.linalg.norm(center)
        right = np.cross([0, 1, 0], forward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        roll = cv2.Rodrigues(np.array([0, 0, 0.3 * t]))[0]
        rotation = roll @ rotation
        out.append(np.column_stack([rotation, -rotation @ center]))
    return np.array(out)


def render(
    pose: NDArray[np.float64], camera: Camera, image: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Renders the plane z = 0, on which the texture covers [-1.5, 1.5]²."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    ray = camera.rays(np.column_stack([x.ravel(), y.ravel()]))
    direction = np.column_stack([ray, np.ones(len(ray))]) @ pose[:, :3]
    center = -pose[:, :3].T @ pose[:, 3]
    hit = center - direction * (center[2] / direction[:, 2])[:, None]
    at = ((hit[:, :2] + 1.5) / 3 * len(image) - 0.5).astype(np.float32)
    at = at.reshape(camera.height, camera.width, 2)
    return cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """w, x, y, z of a rotation by less than half a turn."""
    w = np.sqrt(1 + np.trace(rotation)) / 2
    skew = rotation - rotation.T
    return np.array([w, skew[2, 1] / (4 * w), skew[0, 2] / (4 * w), skew[1, 0] / (4 * w)])


def write_model(
    folder: Path, camera: Camera, names: list[str], cam_from_world: NDArray[np.float64]
) -> None:
    """Write a COLMAP text model without points, as in data sets with true poses."""
    folder.mkdir(parents=True)
    params = " ".join(map(str, camera.params))
    (folder / "cameras.txt").write_text(
        f"1 {camera.model} {camera.width} {camera.height} {params}\n"
    )
    lines = []
    for i, (name, pose) in enumerate(zip(names, cam_from_world, strict=True)):
        numbers = " ".join(repr(float(v)) for v in (*quaternion(pose[:, :3]), *pose[:, 3]))
        lines.append(f"{i + 1} {numbers} 1 {name}\n\n")
    (folder / "images.txt").write_text("".join(lines))


def write_sequence(folder: Path, camera: Camera = PINHOLE, count: int = 8) -> Path:
    """A sequence folder with images/ and sparse/: img1.png, img2.png, ..., img10.png, ..."""
    names = [f"img{i + 1}.png" for i in range(count)]
    (folder / "images").mkdir(parents=True)
    plane = texture()
    for name, pose in zip(names, poses(count), strict=True):
        cv2.imwrite(str(folder / "images" / name), render(pose, camera, plane))
    write_model(folder / "sparse", camera, names, poses(count))
    return folder
