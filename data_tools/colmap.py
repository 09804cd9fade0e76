"""Models of structure from motion as COLMAP, GLOMAP and hloc write them, text or binary, as arrays."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.colmap_binary import (
    check_frames,
    check_rigs,
    not_whole,
    read_images,
    read_points,
)
from acino_fte.data_tools.point_cloud import PointCloud
from acino_fte.errors import InputError

HALF_PIXEL = 0.5
"""COLMAP has the centre of the first pixel at (0.5, 0.5), this project at (0, 0)."""

_FILES = ("cameras", "images", "points3D")
_PLACES = (".", "sparse", "colmap/sparse", "sfm", "dense/sparse")
_QUATERNION_ERROR = 1e-3


@dataclass(frozen=True, eq=False)
class DeclaredRig:
    """A rig that the model declares (COLMAP 3.12 and later). S sensors.

    Attributes
    ----------
    rig_id : int
    camera_ids : tuple of int
        COLMAP's camera of each sensor; the first is the reference.
    rotation : (S, 3, 3)
        Rig to sensor; NaN for a sensor without a pose.
    translation : (S, 3)
        Rig to sensor, in the model's units.
    """

    rig_id: int
    camera_ids: tuple[int, ...]
    rotation: np.ndarray
    translation: np.ndarray


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A sparse model. I images with a pose, Q points, K observations.

    Attributes
    ----------
    path : Path
        The folder of the model's files.
    cameras : dict of int to Camera
        COLMAP's camera id → lens, with the identity as its pose.
    image_ids : (I,) int
        Images with a pose only, in the order of `names`.
    names : tuple of str (I,)
        Sorted.
    camera_ids : (I,) int
        The camera of each image.
    rotation, translation : (I, 3, 3), (I, 3)
        World to camera, in the model's units.
    cloud : PointCloud
        The points, by rising id.
    observed_image, observed_point : (K,) int
        Indices into the images and the points.
    observed_xy : (K, 2)
        Pixels, centres at integers.
    declared_rigs : tuple of DeclaredRig
        Rigs of more than one sensor.
    rig_ids, frame_ids : (I,) int
        COLMAP's rig and frame of each image; of models without them as pycolmap makes them up.
    notes : tuple of str
        What a user should know of the model.
    """

    path: Path
    cameras: dict[int, Camera]
    image_ids: np.ndarray
    names: tuple[str, ...]
    camera_ids: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    cloud: PointCloud
    observed_image: np.ndarray
    observed_point: np.ndarray
    observed_xy: np.ndarray
    declared_rigs: tuple[DeclaredRig, ...] = ()
    rig_ids: np.ndarray = None  # type: ignore[assignment]
    frame_ids: np.ndarray = None  # type: ignore[assignment]
    notes: tuple[str, ...] = ()


def read_colmap(path: Path | str) -> ColmapModel:
    """Read a sparse model.

    Parameters
    ----------
    path : Path
        The folder of the model, or one with it in ``sparse``, ``sparse/0`` and so on. Of several models the
        one with most images is taken.

    Returns
    -------
    ColmapModel

    Raises
    ------
    InputError
        There is no model, it is broken, or it has no image with a pose; the message names the file and the
        remedy. Also when pycolmap is not installed.
    """
    folder, notes = _find_model(Path(path))
    ending = _ending(folder)
    if ending == "bin":
        for name, check in (("rigs.bin", check_rigs), ("frames.bin", check_frames)):
            if (folder / name).is_file():
                check(folder / name)
        images, points = read_images(folder / "images.bin"), read_points(folder / "points3D.bin")
        model = _read_with_pycolmap(folder)
        _check_size(folder / "cameras.bin", model)
    else:
        model = _read_with_pycolmap(folder)
        with tempfile.TemporaryDirectory(prefix="colmap-") as binary:
            model.write_binary(binary)
            images = read_images(Path(binary) / "images.bin")
            points = read_points(Path(binary) / "points3D.bin")
    order, posed = _posed_images(model, folder / f"images.{ending}", notes)
    rotation, translation = _poses([image.cam_from_world() for image in posed], folder / f"images.{ending}")
    points = points[np.argsort(points["id"])]
    cloud = _cloud(points, folder / f"points3D.{ending}")
    rows = {image_id: row for row, image_id in enumerate(images.ids.tolist())}
    observations = [images.observations[rows[image_id]] for image_id in order]
    seen = _observations(observations, points["id"], notes)
    return ColmapModel(
        path=folder,
        cameras=_cameras(model, {image.camera_id for image in posed}, folder / f"cameras.{ending}"),
        image_ids=np.array(order, dtype=np.int64),
        names=tuple(image.name for image in posed),
        camera_ids=np.array([image.camera_id for image in posed], dtype=np.int64),
        rotation=rotation,
        translation=translation,
        cloud=cloud,
        observed_image=seen[0],
        observed_point=seen[1],
        observed_xy=seen[2],
        declared_rigs=_declared_rigs(model, folder),
        rig_ids=np.array([image.frame.rig_id for image in posed], dtype=np.int64),
        frame_ids=np.array([image.frame_id for image in posed], dtype=np.int64),
        notes=tuple(notes),
    )


def _ending(folder: Path) -> str | None:
    """``bin`` or ``txt`` of a folder with a whole model (binary first, as COLMAP has it), else None."""
    for ending in ("bin", "txt"):
        if all((folder / f"{name}.{ending}").is_file() for name in _FILES):
            return ending
    return None


def _find_model(path: Path) -> tuple[Path, list[str]]:
    """The folder of the model, and what to note about the choice."""
    if not path.is_dir():
        found = "a file" if path.exists() else "nothing"
        raise InputError(
            "There is no such COLMAP model.",
            file=path,
            expected="a folder",
            found=found,
            remedy="check the path",
        )
    for place in _PLACES:
        base = path / place
        if _ending(base):
            return base, []
        if base.is_dir():
            numbered = [p for p in base.iterdir() if p.name.isdigit() and _ending(p)]
            if numbered:
                return _largest(sorted(numbered, key=lambda p: int(p.name)))
    _refuse_part(path)
    raise InputError(
        "The folder holds no COLMAP model.",
        file=path,
        expected="cameras, images and points3D (.bin or .txt), here or in sparse, sparse/0, …",
        found=", ".join(sorted(p.name for p in path.iterdir())[:12]) or "an empty folder",
        remedy="give the folder of the model, or export it: `colmap model_converter --output_type BIN`",
    )


def _refuse_part(path: Path) -> None:
    """Raise when there is a model of which a file is missing."""
    for place in _PLACES:
        for ending in ("bin", "txt"):
            missing = [f"{n}.{ending}" for n in _FILES if not (path / place / f"{n}.{ending}").is_file()]
            if len(missing) < len(_FILES):
                raise InputError(
                    "A file of the COLMAP model is missing.",
                    file=path / place,
                    expected=", ".join(f"{name}.{ending}" for name in _FILES),
                    found=f"no {', no '.join(missing)}",
                    remedy="copy the whole folder of the model",
                )


def _largest(folders: list[Path]) -> tuple[Path, list[str]]:
    """The model with most images, the first of equals."""
    if len(folders) == 1:
        return folders[0], []
    counts = [_count_images(folder) for folder in folders]
    best = int(np.argmax(counts))
    others = ", ".join(
        f"{f.name} ({n})" for i, (f, n) in enumerate(zip(folders, counts, strict=True)) if i != best
    )
    note = (
        f"Of {len(folders)} models, {folders[best]} is read, which has most images ({counts[best]}); "
        f"left out: {others}."
    )
    return folders[best], [note]


def _count_images(folder: Path) -> int:
    if _ending(folder) == "bin":
        with (folder / "images.bin").open("rb") as file:
            return int.from_bytes(file.read(8), "little")
    with (folder / "images.txt").open("rb") as file:
        return sum(1 for line in file if not line.startswith(b"#")) // 2


@contextmanager
def _silent(pycolmap: Any) -> Iterator[None]:
    """pycolmap without its log on stderr; errors come as exceptions."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def _read_with_pycolmap(folder: Path) -> Any:
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(
            "COLMAP models are read by pycolmap, which is not installed.",
            found=str(error),
            remedy='pip install "acino-fte[colmap]"',
        ) from error
    with _silent(pycolmap):
        try:
            return pycolmap.Reconstruction(str(folder))
        except (ValueError, IndexError, KeyError, RuntimeError, MemoryError, TypeError, OSError) as error:
            raise InputError(
                "The COLMAP model cannot be read.",
                file=folder,
                expected="a whole model of COLMAP, of one export",
                found=str(error).replace("\n", " ").strip() or type(error).__name__,
                remedy="copy the model again, or export it again with `colmap model_converter`",
            ) from error


def _check_size(path: Path, model: Any) -> None:
    """Raise when ``cameras.bin`` is longer or shorter than its cameras."""
    expected = 8 + sum(24 + 8 * len(camera.params) for camera in model.cameras.values())
    if path.stat().st_size != expected:
        raise not_whole(path)


def _posed_images(model: Any, file: Path, notes: list[str]) -> tuple[list[int], list[Any]]:
    """Ids and objects of the images with a pose, sorted by name; names are checked."""
    images = list(model.images.items())
    posed = sorted(((i, image) for i, image in images if image.has_pose), key=lambda pair: pair[1].name)
    if not posed:
        raise InputError(
            "No image of the COLMAP model has a pose.",
            file=file,
            expected="registered images",
            found=f"{len(images)} images",
            remedy="run the reconstruction again; another model may be in sparse/1, sparse/2, …",
        )
    if len(posed) < len(images):
        notes.append(f"{len(images) - len(posed)} of {len(images)} images have no pose and are left out.")
    twice = [name for name, n in Counter(image.name for _, image in posed).items() if n > 1]
    if twice:
        raise InputError(
            "Two images of the COLMAP model have one name.",
            file=file,
            found=", ".join(twice[:3]),
            remedy="name the images apart, with a folder for each camera",
        )
    return [i for i, _ in posed], [image for _, image in posed]


def _poses(rigid: list[Any], file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (I, 3, 3) and translations (I, 3) of pycolmap's rigid motions; the quaternions are normed."""
    quaternion = np.array([each.rotation.quat for each in rigid], dtype=float).reshape(-1, 4)
    translation = np.array([each.translation for each in rigid], dtype=float).reshape(-1, 3)
    norm = np.linalg.norm(quaternion, axis=1)
    wrong = ~(np.abs(norm - 1) < _QUATERNION_ERROR) | ~np.isfinite(translation).all(axis=1)
    if wrong.any():
        raise InputError(
            "A pose of the COLMAP model is impossible.",
            file=file,
            expected="quaternions of length 1, finite translations",
            found=f"{int(wrong.sum())} of {len(wrong)} poses, a quaternion of length {norm[wrong][0]:.4g}",
            remedy="export the model again; the columns are QW, QX, QY, QZ, TX, TY, TZ",
        )
    return _rotations(quaternion / norm[:, None]), translation


def _rotations(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices (I, 3, 3) of unit quaternions x, y, z, w (I, 4)."""
    v, w = quaternion[:, :3], quaternion[:, 3]
    zero = np.zeros(len(w))
    cross = np.stack([zero, -v[:, 2], v[:, 1], v[:, 2], zero, -v[:, 0], -v[:, 1], v[:, 0], zero], axis=1)
    cross = cross.reshape(-1, 3, 3)
    return np.eye(3) + 2 * (w[:, None, None] * cross + cross @ cross)


def _cloud(points: np.ndarray, file: Path) -> PointCloud:
    """The points; an error below 0 means that it is not known (COLMAP's convention)."""
    if not np.isfinite(points["xyz"]).all():
        raise InputError(
            "A point of the COLMAP model is not finite.",
            file=file,
            expected="finite positions",
            found=f"point {points['id'][~np.isfinite(points['xyz']).all(axis=1)][0]}",
            remedy="filter the points in COLMAP (`colmap point_filtering`)",
        )
    if len(np.unique(points["id"])) != len(points):
        raise not_whole(file)
    error = np.where(points["error"] >= 0, points["error"], np.nan)
    return PointCloud(points["xyz"].copy(), points["rgb"].copy(), error)


def _observations(
    observations: list[np.ndarray], point_ids: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image (K,), point (K,) and pixel (K, 2) of all observations whose point is in the model."""
    counts = [len(rows) for rows in observations]
    rows = np.concatenate(observations)
    image = np.repeat(np.arange(len(counts)), counts)
    point = np.minimum(np.searchsorted(point_ids, rows["point"]), max(len(point_ids) - 1, 0))
    known = point_ids[point] == rows["point"] if len(point_ids) else np.zeros(len(rows), dtype=bool)
    xy = rows["xy"] - HALF_PIXEL
    if not known.all():
        lost = len(rows) - int(known.sum())
        notes.append(f"{lost} of {len(rows)} observations are of points that points3D lacks: left out.")
    known &= np.isfinite(xy).all(axis=1)
    return image[known], point[known], xy[known]


def _cameras(model: Any, used: set[int], file: Path) -> dict[int, Camera]:
    """The lenses of the cameras that have images."""
    cameras = {}
    for camera_id in sorted(used):
        camera = model.cameras[camera_id]
        if not np.isfinite(camera.params).all() or camera.width < 1 or camera.height < 1:
            raise InputError(
                f"Camera {camera_id} of the COLMAP model is impossible.",
                file=file,
                expected="a size of at least 1 × 1 px, finite parameters",
                found=f"{camera.width} × {camera.height} px, {', '.join(f'{p:g}' for p in camera.params)}",
                remedy="run the reconstruction again, or mend the camera",
            )
        cameras[camera_id] = _camera_from_colmap(camera, f"camera {camera_id}")
    return cameras


def _camera_from_colmap(camera: Any, name: str) -> Camera:
    """Stand-in until the lens models land."""
    p = np.asarray(camera.params, dtype=float)
    model, distortion = "pinhole", np.zeros(4)
    kind = camera.model.name
    if kind in ("SIMPLE_RADIAL", "SIMPLE_PINHOLE"):
        distortion[: len(p) - 3] = p[3:]
        p = p[[0, 0, 1, 2]]
    elif kind in ("OPENCV", "OPENCV_FISHEYE", "PINHOLE"):
        distortion[: len(p) - 4] = p[4:]
        model = "fisheye" if kind == "OPENCV_FISHEYE" else "pinhole"
    else:
        raise InputError(f"The camera model {kind} is not known.", key=name)
    matrix = np.array([[p[0], 0, p[2] - HALF_PIXEL], [0, p[1], p[3] - HALF_PIXEL], [0, 0, 1]])
    return Camera(
        name, model, matrix, distortion, np.eye(3), np.zeros(3), (int(camera.width), int(camera.height))
    )


def _declared_rigs(model: Any, folder: Path) -> tuple[DeclaredRig, ...]:
    """The rigs of more than one camera, by id."""
    rigs = []
    for rig_id, rig in sorted(model.rigs.items()):
        if rig.num_sensors() < 2:
            continue
        reference = rig.ref_sensor_id.id
        camera_ids, rotation, translation = [reference], [np.eye(3)], [np.zeros(3)]
        for sensor, pose in sorted(rig.non_ref_sensors.items(), key=lambda pair: pair[0].id):
            if sensor.type.name != "CAMERA":
                continue
            turn, shift = np.full((3, 3), np.nan), np.full(3, np.nan)
            if pose is not None:
                turn, shift = (part[0] for part in _poses([pose], folder / f"rigs.{_ending(folder)}"))
            camera_ids.append(sensor.id)
            rotation.append(turn)
            translation.append(shift)
        if len(camera_ids) > 1:
            rigs.append(DeclaredRig(rig_id, tuple(camera_ids), np.array(rotation), np.array(translation)))
    return tuple(rigs)
