"""A small world for the calibration page: a camera, a lidar beside it, targets for both, and its files."""

from functools import cache
from pathlib import Path

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.rotations import rotation_matrix

WIDTH, HEIGHT = 640, 480
IMAGES = ("near.png", "far.png")
N_TARGETS = 9
_INTRINSICS = """image_width: 640
image_height: 480
camera_name: cam1
camera_matrix: {rows: 3, cols: 3, data: [900, 0, 322, 0, 900, 236, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
"""
_AXES = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0.0]])  # the camera looks along the lidar's x


@cache
def camera() -> Camera:
    """The true camera; its world is the frame of the lidar."""
    matrix = np.array([[900, 0, 322.0], [0, 900, 236], [0, 0, 1]])
    rotation = rotation_matrix(np.array([0.02, -0.03, 0.01])) @ _AXES
    return Camera(
        "cam1", "pinhole", matrix, np.zeros(5), rotation, np.array([0.2, 0.1, -0.05]), (WIDTH, HEIGHT)
    )


@cache
def targets(image: str) -> np.ndarray:
    """Places (9, 3) of the targets of an image, m; three by three in the image, at many distances."""
    rng = np.random.default_rng(IMAGES.index(image))
    away = (6.0 if image == "near.png" else 12.0) * rng.uniform(1, 1.8, N_TARGETS)
    across, up = (side.ravel() for side in np.meshgrid([-0.22, 0.0, 0.22], [-0.16, 0.0, 0.16]))
    return np.stack([away, -across * away, up * away], axis=1) + rng.normal(0, 0.05, (N_TARGETS, 3))


def pixels(image: str) -> np.ndarray:
    """Where the targets are in the image (9, 2), px."""
    return camera().project(targets(image))


@cache
def cloud(image: str) -> tuple[np.ndarray, np.ndarray]:
    """The targets, bright, and a dark wall behind them."""
    rng = np.random.default_rng(7)
    wall = np.stack([np.full(3000, 30.0), rng.uniform(-9, 9, 3000), rng.uniform(-7, 7, 3000)], axis=1)
    return np.concatenate([targets(image), wall]), np.r_[np.full(N_TARGETS, 150.0), np.full(3000, 10.0)]


def picture(image: str) -> np.ndarray:
    """The image (480, 640, 3), uint8."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    out = np.full((HEIGHT, WIDTH, 3), 90, dtype=np.uint8)
    for u, v in pixels(image):
        out[(columns - u) ** 2 + (rows - v) ** 2 < 25] = (255, 240, 200)
    return out


def write_world(folder: Path) -> list[str]:
    """Write images and clouds; the arguments of ``scripts/calibrate_lidar.py`` for them."""
    import cv2

    arguments = []
    for image in IMAGES:
        cv2.imwrite(str(folder / image), picture(image)[..., ::-1])
        xyz, intensity = cloud(image)
        path = folder / image.replace("png", "npz")
        np.savez(path, xyz=xyz, intensity=intensity)
        arguments += ["--cloud", str(path)]
    (folder / "ost.yaml").write_text(_INTRINSICS)
    return [str(folder / image) for image in IMAGES] + arguments + ["--camera", str(folder / "ost.yaml")]
