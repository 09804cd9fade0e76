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
    RawImages,
    check_frames,
    check_rigs,
    not_whole,
    read_images,
    read_points,
)
from acino_fte.data_tools.colmap_cameras import camera_from_colmap
from acino_fte.data_tools.colmap_folders import find_model, model_ending
from acino_fte.data_tools.point_cloud import PointCloud
from acino_fte.errors import InputError

HALF_PIXEL = 0.5
"""COLMAP has the centre of the first pixel at (0.5, 0.5), this project at (0, 0)."""

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
    folder, notes = find_model(Path(path))
    ending = model_ending(folder)
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
    seen = _observations(images, order, points["id"], notes)
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
    try:
        posed = sorted(((i, image) for i, image in images if image.has_pose), key=lambda pair: pair[1].name)
    except UnicodeDecodeError as error:
        raise InputError(
            "The name of an image is not text.",
            file=file,
            expected="UTF-8",
            found=repr(error.object),
            remedy="rename the image, or copy the model again",
        ) from error
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
    with np.errstate(over="ignore"):
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
    images: RawImages, image_ids: list[int], point_ids: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image (K,), point (K,) and pixel (K, 2) of all observations whose point is in the model."""
    image, xy, ids = images.of_images(image_ids)
    point = np.minimum(np.searchsorted(point_ids, ids), max(len(point_ids) - 1, 0))
    known = point_ids[point] == ids if len(point_ids) else np.zeros(len(ids), dtype=bool)
    if not known.all():
        lost = len(ids) - int(known.sum())
        notes.append(f"{lost} of {len(ids)} observations are of points that points3D lacks: left out.")
    finite = np.isfinite(xy).all(axis=1)
    if not finite.all():
        notes.append(f"{int((~finite).sum())} of {len(ids)} observations have no finite pixel: left out.")
    known &= finite
    return image[known], point[known], xy[known] - HALF_PIXEL


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
        try:
            cameras[camera_id] = camera_from_colmap(camera, f"camera {camera_id}")
        except InputError as error:
            raise InputError(
                error.problem,
                file=file,
                key=error.key,
                expected=error.expected,
                found=error.found,
                remedy=error.remedy,
            ) from error
    return cameras


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
                turn, shift = (part[0] for part in _poses([pose], folder / f"rigs.{model_ending(folder)}"))
            camera_ids.append(sensor.id)
            rotation.append(turn)
            translation.append(shift)
        if len(camera_ids) > 1:
            rigs.append(DeclaredRig(rig_id, tuple(camera_ids), np.array(rotation), np.array(translation)))
    return tuple(rigs)
