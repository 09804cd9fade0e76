"""What the tests of scenes share: smooth motions, key frames, cameras on a ring, sizes of errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from data_tools_synthetic import look_at
from scipy.spatial.transform import Rotation

from acino_fte.cameras import Camera
from acino_fte.data_tools.camera_keys import KeyedCamera
from acino_fte.data_tools.camera_paths import CameraPath
from acino_fte.data_tools.scene_motions import waves
from acino_fte.data_tools.scene_rows import Views, make_views
from acino_fte.data_tools.similarity import Similarity
from acino_fte.data_tools.tracks2d import Tracks2D

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
FPS = 30.0
SIZE = (2704, 1520)
MATRIX = np.array([[1250.0, 0, 1351.5], [0, 1245.0, 759.5], [0, 0, 1]])
PINHOLE = Camera("lens", "pinhole", MATRIX, np.zeros(0), np.eye(3), np.zeros(3), SIZE)
FISHEYE = Camera("lens", "fisheye", MATRIX, [0.02, -0.01, 0.003, 0.0], np.eye(3), np.zeros(3), SIZE)


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def nees(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Squared errors (T,) in units of their covariances, over the dimension: 1 in the mean."""
    solved = np.linalg.solve(covariance, error[..., None])[..., 0]
    return (error * solved).sum(-1) / error.shape[-1]


class Motion:
    """A smooth motion: rotations, world to camera, and centres at any frame."""

    def __init__(self, seed: int, sway: float = 0.4, turn: float = 0.3, start: np.ndarray | None = None):
        rng = np.random.default_rng(seed)
        self._shift, self._turn = waves(rng, (3,), (0.05, 0.35)), waves(rng, (3,), (0.05, 0.35))
        self._sway, self._angle = sway, turn
        self._start = Rotation.identity() if start is None else Rotation.from_matrix(start)
        self._walk = np.array([0.5, 0.1, 0.0])

    def __call__(self, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (N, 3, 3) and centres (N, 3)."""
        time = np.asarray(frame, dtype=float) / FPS
        turn = Rotation.from_rotvec(self._angle * self._turn(time)) * self._start
        return turn.as_matrix(), self._sway * self._shift(time) + time[:, None] * self._walk


def keyed(
    name: str,
    frame: np.ndarray,
    rotation: np.ndarray,
    centre: np.ndarray,
    turn: float = 0.0,
    shift: float = 0.0,
    rng: np.random.Generator | None = None,
    lens: Camera = PINHOLE,
) -> KeyedCamera:
    """Key frames with errors of these standard deviations (rad, m); `rotation` and `centre` are the truth."""
    covariance = None
    if rng is not None:
        n = len(frame)
        rotation = Rotation.from_rotvec(turn * rng.normal(size=(n, 3))).as_matrix() @ rotation
        centre = centre + shift * rng.normal(size=(n, 3))
        covariance = np.tile(np.diag([turn**2] * 3 + [shift**2] * 3), (n, 1, 1))
    translation = -np.einsum("kij,kj->ki", rotation, centre)
    return KeyedCamera(name, lens, 1, np.asarray(frame), rotation, translation, covariance)


def pose_errors(path: CameraPath, rotation: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Errors (N, 6) of a path as its covariances mean them: turn (camera's frame), shift of the centre."""
    turn = Rotation.from_matrix(rotation @ path.rotation.transpose(0, 2, 1)).as_rotvec()
    return np.concatenate([turn, centre - path.centre], axis=1)


def random_similarity(rng: np.random.Generator, decades: float = 2.0) -> Similarity:
    """Any turn, a shift of some units, 10^±decades units per unit."""
    turn = Rotation.random(random_state=rng).as_matrix()
    scale = float(10.0 ** rng.uniform(-decades, decades))
    return Similarity(scale, turn, scale * rng.uniform(-10.0, 10.0, 3))


def ring_paths(
    n_cameras: int, n_frames: int, turn: float = 0.0, shift: float = 0.0, radius: float = 4.0
) -> list[CameraPath]:
    """True paths of cameras on a circle that look at the origin and sway; covariances of given errors."""
    paths = []
    for c in range(n_cameras):
        angle = 2 * np.pi * c / max(n_cameras, 3) + 0.3 * np.sin(5.0 * c)
        centre = radius * np.array([np.cos(angle), np.sin(angle), 0.3 + 0.1 * (c % 3)])
        rotation, _ = look_at(centre, np.zeros(3))
        frame = np.arange(n_frames)
        sway, shifts = Motion(100 + c, 0.2, 0.05)(frame)
        sway, centres = sway @ rotation, centre + shifts - shifts[0] - np.outer(frame / FPS, [0.5, 0.1, 0.0])
        paths.append(exact_path(f"cam{c}", frame, sway, centres, turn, shift))
    return paths


def exact_path(
    name: str,
    frame: np.ndarray,
    rotation: np.ndarray,
    centre: np.ndarray,
    turn: float = 0.0,
    shift: float = 0.0,
) -> CameraPath:
    """A path with these poses, and covariances of these standard deviations (rad, m)."""
    n = len(frame)
    covariance = np.tile(np.diag([turn**2] * 3 + [shift**2] * 3), (n, 1, 1))
    translation = -np.einsum("nij,nj->ni", rotation, centre)
    yes = np.ones(n, dtype=bool)
    return CameraPath(name, frame, rotation, translation, covariance, yes, yes)


def disturbed(path: CameraPath, turn: np.ndarray, shift: np.ndarray) -> CameraPath:
    """The path with its poses off by turns (N, 3), rad, and shifts (N, 3), m; its covariances stay."""
    rotation = Rotation.from_rotvec(turn).as_matrix() @ path.rotation
    other = exact_path(path.name, path.frame, rotation, path.centre + shift)
    return CameraPath(
        path.name, path.frame, other.rotation, other.translation, path.covariance, path.known, path.key
    )


def own_views(paths: list[CameraPath], lenses: list[Camera] | None = None) -> Views:
    """Views of cameras that err apart."""
    return make_views(lenses or [PINHOLE] * len(paths), paths, paths, range(len(paths)))


def wander(n_frames: int, n_individuals: int, seed: int, roam: float = 0.8) -> np.ndarray:
    """Smooth positions (I, N, 3) about the origin, m."""
    rng = np.random.default_rng(seed)
    way = waves(rng, (n_individuals, 3), (0.05, 0.4))(np.arange(n_frames) / FPS)
    return np.moveaxis(roam * way, 1, 0)


def dots(
    views: Views,
    positions: np.ndarray,
    noise: float,
    rng: np.random.Generator,
    seen: np.ndarray | None = None,
) -> list[Tracks2D]:
    """Tracks of positions (I, N, 3) in each camera, px; `seen` (C, I, N) tells which dots there are."""
    n_individuals, n_frames = positions.shape[:2]
    names = tuple(f"a{i}" for i in range(n_individuals))
    tracks = []
    for c, camera in enumerate(views.cameras):
        pixels = camera.project(np.moveaxis(positions, 1, 0)) + noise * rng.normal(
            size=(n_frames, n_individuals, 2)
        )
        there = np.isfinite(pixels).all(-1)
        if seen is not None:
            there &= seen[c].T
        frame, individual = np.nonzero(there)
        tracks.append(Tracks2D(camera.name, frame, individual, pixels[there], names, individual))
    return tracks


def names_of(positions: np.ndarray) -> list[str]:
    """Names of the individuals of :func:`dots`."""
    return [f"a{i}" for i in range(len(positions))]
