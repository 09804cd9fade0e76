"""A small recording for the tests of data_tools: fixed numbers, no files from elsewhere."""

import json
from pathlib import Path

import numpy as np
import pytest

from acino_fte.cameras import Camera, CameraArray
from acino_fte.data_tools.calibration import write_cameras
from acino_fte.data_tools.deeplabcut import write_deeplabcut_csv
from acino_fte.data_tools.sequence_file import write_sequence_file
from acino_fte.errors import InputError
from acino_fte.skeleton import load_skeleton

LILY = Path(__file__).resolve().parents[2] / "shared" / "data" / "lily_run"
needs_lily = pytest.mark.skipif(not LILY.is_dir(), reason="the real sequence shared/data/lily_run is absent")
MARKERS = load_skeleton("cheetah").marker_names
N_FRAMES = 40


def look_at(centre: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera rotation and translation of an upright camera."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rotation, -rotation @ centre


def ring(n_cameras: int = 4, model: str = "fisheye") -> CameraArray:
    """Cameras on a circle of 8 m, at uneven angles and heights, looking at the middle."""
    cameras = []
    for i in range(n_cameras):
        angle = 2 * np.pi * i / n_cameras + 0.3 * np.sin(5.0 * i)
        centre = np.array([8 * np.cos(angle), 8 * np.sin(angle), 1.2 + 0.4 * (i % 3)])
        rotation, translation = look_at(centre, np.array([0.0, 0.0, 0.5]))
        matrix = np.array([[1200.0, 0, 960], [0, 1195.0, 540], [0, 0, 1]])
        distortion = np.array([0.02, -0.01, 0.003, 0.0]) if model == "fisheye" else np.zeros(5)
        cameras.append(Camera(f"cam{i + 1}", model, matrix, distortion, rotation, translation, (1920, 1080)))
    return CameraArray(tuple(cameras))


def cloud(n_frames: int = N_FRAMES, n_markers: int = len(MARKERS)) -> np.ndarray:
    """(N, M, 3) points that run past, m."""
    rng = np.random.default_rng(3)
    body = rng.normal(0, [0.5, 0.15, 0.2], (n_markers, 3)) + [0, 0, 0.6]
    path = np.linspace([-1.5, -0.8, 0], [1.5, 0.9, 0.2], n_frames)
    return body + path[:, None] + rng.normal(0, 0.02, (n_frames, n_markers, 3))


def pixels(cameras: CameraArray, noise: float = 1.5) -> np.ndarray:
    """(N, C, M, 2) noisy detections of the cloud."""
    exact = cameras.project(cloud())
    return exact + np.random.default_rng(4).normal(0, noise, exact.shape)


def write_recording(folder: Path, n_cameras: int = 4, names=MARKERS, **changes) -> Path:
    """A folder with a sequence.yaml, cameras.json and one CSV per camera."""
    cameras = ring(n_cameras)
    folder.mkdir(parents=True, exist_ok=True)
    write_cameras(folder / "cameras.json", cameras)
    points = pixels(cameras)
    for c, camera in enumerate(cameras):
        write_deeplabcut_csv(
            folder / f"{camera.name}.csv",
            names,
            points[:, c],
            np.full(points.shape[:1] + points.shape[2:3], 0.9),
        )
    content = {
        "format": "acino-fte/sequence/1",
        "species": "cheetah",
        "fps": 120.0,
        "cameras": "cameras.json",
        "keypoints": {camera.name: f"{camera.name}.csv" for camera in cameras},
    }
    write_sequence_file(folder / "sequence.yaml", {**content, **changes})
    return folder


def write_scene(path: Path, cameras: CameraArray) -> None:
    """A scene as AcinoSet writes it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    entries = [
        {
            "k": c.matrix.tolist(),
            "d": c.distortion[:, None].tolist(),
            "r": c.rotation.tolist(),
            "t": c.translation[:, None].tolist(),
        }
        for c in cameras
    ]
    scene = {"created_timestamp": "x", "camera_resolution": [1920, 1080], "cameras": entries}
    path.write_text(json.dumps(scene), encoding="utf-8")


def write_acinoset(folder: Path, n_files: int = 4, n_cameras: int = 4) -> Path:
    """An AcinoSet folder two levels below its calibration."""
    cameras = ring(max(n_files, n_cameras))
    scene = folder / "extrinsic_calib" / f"{n_cameras}_cam_scene_sba.json"
    write_scene(scene, CameraArray(tuple(cameras)[:n_cameras]))
    run = folder / "lily" / "run1"
    (run / "dlc").mkdir(parents=True)
    points = pixels(cameras)
    for c in range(n_files):
        sure = np.full(points.shape[:1] + points.shape[2:3], 0.9)
        write_deeplabcut_csv(run / "dlc" / f"cam{c + 1}DLC_net.csv", MARKERS, points[:, c], sure)
    return run


def message(call, *args, **kwargs) -> InputError:
    """The InputError that a call raises; it must name a remedy or what was expected."""
    with pytest.raises(InputError) as caught:
        call(*args, **kwargs)
    assert caught.value.remedy or caught.value.expected
    return caught.value
