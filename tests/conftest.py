"""What the tests of the core share: a small animal, cameras about it, and random problems."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the tests run side by side; read when NumPy is imported

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from hypothesis import settings

from acino_fte.cameras import Camera, CameraArray
from acino_fte.kinematics import Kinematics, load_kinematics
from acino_fte.losses import Loss
from acino_fte.problem import FTEOptions, FTEProblem, build_problem
from acino_fte.sequence import Sequence
from acino_fte.skeleton import Skeleton, expand, load_skeleton
from acino_fte.species_file import SpeciesFile
from acino_fte.terms import measurement_term

settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")

# Files that take longest (10 s and more), longest first: begun last, they would keep one process waiting.
LONGEST = (
    "test_lily",
    "test_docs",
    "test_run_cli",
    "test_scene_reaches",
    "test_calibration",
    "test_matching_reaches",
    "test_recovery",
    "test_plots",
    "test_fusion_reaches",
    "test_lidar_tutorial",
    "test_diagnosis",
    "test_explicit",
    "test_assignments",
    "test_match_cli",
    "test_scene_faults",
    "test_odometry",
    "test_compare_cli",
    "test_condensed",
    "test_scene_cli",
    "test_scene_tutorial",
    "test_calibrate_page",
    "test_adjust_page",
    "test_lidar_solve_reaches",
    "test_bags_damage",
)


def pytest_configure(config: pytest.Config) -> None:
    """Keep pytest-xdist to the order of collection: it would put files of few tests, the longest, last."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first; the others stay in their order."""
    rank = {name: i for i, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


FPS = 100.0
FISHEYE = (0.037, 0.048, -0.038, 0.011)
PINHOLE = (-0.12, 0.05, 0.001, -0.0007, 0.01)
LIZARD = {
    "format": "acino-fte/skeleton/1",
    "name": "lizard",
    "noise_fps": FPS,
    "links": {
        "trunk": {
            "parent": "world",
            "dofs": {
                "x": {"slide": "x", "noise": 4},
                "y": {"slide": "y", "noise": 4},
                "z": {"slide": "z", "noise": 4},
                "yaw": {"turn": "z", "noise": 900},
                "pitch": {"turn": "y", "range": [-60, 60], "noise": 900},
            },
        },
        "tail": {
            "parent": "trunk",
            "at": [-0.5, 0, 0],
            "dofs": {
                "yaw": {"turn": "z", "range": [-70, 70], "noise": 2000},
                "pitch": {"turn": "y", "range": [-50, 80], "noise": 2000},
            },
        },
        "l_leg": {
            "parent": "trunk",
            "at": [-0.05, 0.12, -0.02],
            "mirror": "r_leg",
            "dofs": {"flex": {"turn": "y", "range": [-80, 80], "noise": 3000}},
        },
    },
    "markers": {
        "nose": {"link": "trunk", "at": [0.2, 0, 0.05], "sd_px": 2},
        "crest": {"link": "trunk", "at": [-0.3, 0, 0.1], "sd_px": 3},
        "tail_mid": {"link": "tail", "at": [-0.25, 0, 0], "sd_px": 3},
        "tail_tip": {"link": "tail", "at": [-0.45, 0.02, 0.03], "sd_px": 4},
        "l_foot": {"link": "l_leg", "at": [0.02, 0.01, -0.3], "sd_px": 3, "mirror": "r_foot"},
    },
}


@pytest.fixture(scope="session")
def lizard() -> Kinematics:
    """Nine degrees of freedom, six markers."""
    return load_kinematics(expand(SpeciesFile.model_validate(LIZARD)))


@pytest.fixture(scope="session")
def cheetah() -> Kinematics:
    return load_kinematics(load_skeleton("cheetah"))


def look_at(name, place, target, model="pinhole", distortion=None, focal=900.0) -> Camera:
    """A level camera at a place (or a path of places, (N, 3)) with the target in the middle."""
    place, target = np.asarray(place, dtype=float), np.asarray(target, dtype=float)
    forward = target - place
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=-2)
    if distortion is None:
        distortion = FISHEYE if model == "fisheye" else PINHOLE
    matrix = np.array([[focal, 0, 640.0], [0, focal * 1.01, 360.0], [0, 0, 1]])
    translation = -np.einsum("...ij,...j->...i", rotation, place)
    return Camera(name, model, matrix, np.array(distortion), rotation, translation, (1280, 720))


def cameras_about(n_frames=1, moving=False, n=4, target=(0.0, 0.0, 0.0), radius=3.0) -> CameraArray:
    """Pinhole and fisheye cameras in turn, around a target; the first one moves when asked to."""
    cameras = []
    for i in range(n):
        angle = 2 * np.pi * (i + 0.3) / n
        place = np.array(target) + [radius * np.cos(angle), radius * np.sin(angle), 0.8 + 0.2 * i]
        if moving and i == 0:
            place = place + np.linspace(0, 0.4, n_frames)[:, None] * [1.0, -0.5, 0.2]
        cameras.append(look_at(f"c{i}", place, target, ("pinhole", "fisheye")[i % 2]))
    return CameraArray(tuple(cameras))


def random_motion(skeleton: Skeleton, n_frames: int, seed: int) -> np.ndarray:
    """Smooth degrees of freedom (N, Q) well inside their ranges; free ones stay near zero."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, n_frames)[:, None]
    middle = np.array([d.middle for d in skeleton.dofs])
    half = np.array(
        [0.5 * (d.upper - d.lower) if np.isfinite(d.upper - d.lower) else 0.5 for d in skeleton.dofs]
    )
    phase = rng.uniform(0, 2 * np.pi, len(middle))
    return middle + 0.5 * half * np.sin(2.0 * time + phase)


def random_problem(
    kinematics: Kinematics,
    n_frames: int = 6,
    loss: Loss | None = None,
    moving: bool = False,
    seed: int = 0,
    noise_px: float = 3.0,
    outliers: float = 0.1,
) -> tuple[FTEProblem, np.ndarray]:
    """A small trajectory problem and its true q (N, Q)."""
    rng = np.random.default_rng(seed)
    skeleton = kinematics.skeleton
    q = random_motion(skeleton, n_frames, seed)
    cameras = cameras_about(n_frames, moving)
    pixels = cameras.project(kinematics.positions(q))
    pixels += rng.normal(0, noise_px, pixels.shape)
    wild = rng.random(pixels.shape[:3]) < outliers
    pixels[wild] += rng.normal(0, 80, (wild.sum(), 2))
    pixels[rng.random(pixels.shape[:3]) < 0.2] = np.nan
    options = FTEOptions(loss=loss or Loss())
    sd = np.array([m.sd_px for m in skeleton.markers])
    terms = [measurement_term(c, pixels[:, i], sd, options.loss, n_frames) for i, c in enumerate(cameras)]
    frames = np.arange(20, 20 + n_frames)
    return build_problem(kinematics, FPS, frames, [t for t in terms if t is not None], options), q


def make_sequence(
    kinematics: Kinematics,
    q: np.ndarray,
    cameras: CameraArray,
    noise_px: float = 1.0,
    fps: float = FPS,
    seed: int = 0,
    pixels: np.ndarray | None = None,
) -> Sequence:
    """What cameras would have seen of q (N, Q), with its truth; or the given pixels (N, C, M, 2)."""
    positions = kinematics.positions(q)
    if pixels is None:
        pixels = cameras.project(positions)
        pixels = pixels + np.random.default_rng(seed).normal(0, noise_px, pixels.shape)
    dims = ("frame", "camera", "marker")
    names = kinematics.skeleton.marker_names
    found = np.isfinite(pixels).all(-1)
    detections = xr.Dataset(
        {"position": ((*dims, "space"), pixels), "likelihood": (dims, np.where(found, 0.95, 0.0))},
        {"frame": np.arange(len(q)), "camera": cameras.names, "marker": names, "space": ["u", "v"]},
    )
    truth = xr.DataArray(
        positions,
        dims=("frame", "marker", "space"),
        coords={"frame": np.arange(len(q)), "marker": names, "space": ["x", "y", "z"]},
    )
    return Sequence(kinematics.skeleton.name, kinematics.skeleton.name, fps, detections, cameras, truth)


def unlimited(problem: FTEProblem) -> FTEProblem:
    """The problem without bounds."""
    inf = np.full(len(problem.lower), np.inf)
    return replace(problem, lower=-inf, upper=inf)
