"""Models of structure from motion written as COLMAP's text files, from arrays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.data_tools.colmap import HALF_PIXEL
from acino_fte.data_tools.colmap_cameras import colmap_parameters
from acino_fte.errors import InputError

ColmapCamera = Camera | tuple[str, int, int, Sequence[float]]
"""A lens, or COLMAP's model, width, height and parameters."""

_ONE_FOCAL = {
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL",
    "RADIAL_FISHEYE",
    "SIMPLE_DIVISION",
    "SIMPLE_FISHEYE",
}
_GREY = 128
_UNKNOWN_ERROR = -1.0


def write_colmap_text(
    folder: Path | str,
    cameras: Mapping[int, ColmapCamera],
    names: Sequence[str],
    camera_ids: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
    *,
    xyz: np.ndarray | None = None,
    rgb: np.ndarray | None = None,
    error: np.ndarray | None = None,
    observed_image: np.ndarray | None = None,
    observed_point: np.ndarray | None = None,
    observed_xy: np.ndarray | None = None,
) -> None:
    """Write ``cameras.txt``, ``images.txt`` and ``points3D.txt``.

    What :func:`~acino_fte.data_tools.colmap.read_colmap` gives for the files are these arrays. Images and
    points are numbered from 1 in their order. The same arrays make the same bytes.

    Parameters
    ----------
    folder : Path
        Is made when it is not there; the three files are replaced.
    cameras : mapping of int to Camera or (model, width, height, parameters)
        COLMAP's id → the lens (its pose counts nothing); or COLMAP's model and its parameters in COLMAP's
        order, but the principal point with pixel centres at integers: the half pixel is added here.
    names : sequence of str (I,)
        Of the images.
    camera_ids : (I,) int
        The camera of each image.
    rotation, translation : (I, 3, 3), (I, 3)
        World to camera.
    xyz : (Q, 3), optional
        Points; none by default.
    rgb : (Q, 3) uint8, optional
        Their colours; grey by default.
    error : (Q,), optional
        Their mean reprojection errors, px; NaN, and by default, not known.
    observed_image, observed_point : (K,) int, optional
        Image and point of each observation, as indices.
    observed_xy : (K, 2), optional
        Pixels, centres at integers.

    Raises
    ------
    InputError
        Shapes or indices do not fit, a number is not finite, a rotation is not proper, a name has a space
        (COLMAP's text files cannot hold it), or the folder cannot be written.
    """
    folder = Path(folder)
    xyz = np.zeros((0, 3)) if xyz is None else np.asarray(xyz, dtype=float)
    image, point, xy = _observations(observed_image, observed_point, observed_xy, len(names), len(xyz))
    rgb = np.full((len(xyz), 3), _GREY) if rgb is None else np.asarray(rgb)
    error = np.full(len(xyz), _UNKNOWN_ERROR) if error is None else np.asarray(error, dtype=float)
    quaternion, translation = _poses(names, np.asarray(rotation), np.asarray(translation, dtype=float))
    _shape("camera_ids", np.shape(camera_ids), (len(names),))
    _shape("rgb", rgb.shape, (len(xyz), 3))
    _shape("error", error.shape, (len(xyz),))
    _finite("xyz", xyz)
    _check_names(names, camera_ids, cameras)
    order = np.argsort(image, kind="stable")
    image, point, xy = image[order], point[order], xy[order]
    place = np.arange(len(image)) - np.searchsorted(image, image)  # of each observation in its image
    error = np.where(np.isnan(error), _UNKNOWN_ERROR, error)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder / "cameras.txt", _camera_lines(cameras))
        _write(
            folder / "images.txt", _image_lines(names, camera_ids, quaternion, translation, image, point, xy)
        )
        _write(folder / "points3D.txt", _point_lines(xyz, rgb, error, image, point, place))
    except OSError as problem:
        raise InputError("The COLMAP model cannot be written.", file=folder, found=str(problem)) from problem


def _write(path: Path, lines: Iterator[str]) -> None:
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{line}\n" for line in lines)


def _camera_lines(cameras: Mapping[int, ColmapCamera]) -> Iterator[str]:
    yield "# Camera list with one line of data per camera:"
    yield "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"
    yield f"# Number of cameras: {len(cameras)}"
    for camera_id, camera in sorted(cameras.items()):
        if isinstance(camera, Camera):
            (width, height), (model, parameters) = camera.resolution, colmap_parameters(camera)
        else:
            model, width, height, given = camera
            parameters = _with_half_pixel(model, given)
        _finite(f"camera {camera_id}", np.array(parameters))
        yield f"{camera_id} {model} {width} {height} {_numbers(parameters)}"


def _with_half_pixel(model: str, parameters: Sequence[float]) -> list[float]:
    """Parameters with COLMAP's principal point; a panorama has none."""
    values = [float(value) for value in parameters]
    first = 1 if model in _ONE_FOCAL else 2
    if model != "EQUIRECTANGULAR":
        values[first : first + 2] = [value + HALF_PIXEL for value in values[first : first + 2]]
    return values


def _image_lines(
    names: Sequence[str],
    camera_ids: np.ndarray,
    quaternion: np.ndarray,
    translation: np.ndarray,
    image: np.ndarray,
    point: np.ndarray,
    xy: np.ndarray,
) -> Iterator[str]:
    """Two lines for each image; observations sorted by image."""
    yield "# Image list with two lines of data per image:"
    yield "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
    yield "#   POINTS2D[] as (X, Y, POINT3D_ID)"
    mean = len(image) / len(names) if len(names) else 0.0
    yield f"# Number of images: {len(names)}, mean observations per image: {mean!r}"
    bounds = np.searchsorted(image, np.arange(len(names) + 1)).tolist()
    pixels, ids = (xy + HALF_PIXEL).tolist(), (point + 1).tolist()
    pose = np.concatenate([quaternion, translation], axis=1).tolist()
    for i, name in enumerate(names):
        yield f"{i + 1} {_numbers(pose[i])} {int(camera_ids[i])} {name}"
        rows = range(bounds[i], bounds[i + 1])
        yield " ".join(f"{pixels[k][0]!r} {pixels[k][1]!r} {ids[k]}" for k in rows)


def _point_lines(
    xyz: np.ndarray,
    rgb: np.ndarray,
    error: np.ndarray,
    image: np.ndarray,
    point: np.ndarray,
    place: np.ndarray,
) -> Iterator[str]:
    """One line for each point; observations sorted by image."""
    yield "# 3D point list with one line of data per point:"
    yield "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    mean = len(point) / len(xyz) if len(xyz) else 0.0
    yield f"# Number of points: {len(xyz)}, mean track length: {mean!r}"
    order = np.argsort(point, kind="stable")
    bounds = np.searchsorted(point[order], np.arange(len(xyz) + 1)).tolist()
    tracks = [f"{i} {k}" for i, k in zip((image[order] + 1).tolist(), place[order].tolist(), strict=True)]
    colours, errors = rgb.astype(int).tolist(), error.tolist()
    for i, position in enumerate(xyz.tolist()):
        red, green, blue = colours[i]
        track = " ".join(tracks[bounds[i] : bounds[i + 1]])
        yield f"{i + 1} {_numbers(position)} {red} {green} {blue} {errors[i]!r} {track}".rstrip()


def _numbers(values: Sequence[float]) -> str:
    """Numbers that read back as they were."""
    return " ".join(map(repr, values))


def _poses(
    names: Sequence[str], rotation: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Quaternions w, x, y, z (I, 4) with w ≥ 0, and translations (I, 3)."""
    from scipy.spatial.transform import Rotation

    n = len(names)
    _shape("rotation", rotation.shape, (n, 3, 3))
    _shape("translation", translation.shape, (n, 3))
    _finite("rotation", rotation)
    _finite("translation", translation)
    if n == 0:
        return np.zeros((0, 4)), translation
    error = np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    wrong = (error > 1e-6) | (np.linalg.det(rotation) < 0)
    if wrong.any():
        raise InputError(
            f"The rotation of image '{names[int(np.argmax(wrong))]}' is wrong.",
            expected="an orthonormal matrix with determinant +1",
            found=f"|R·Rᵀ − 1| = {error[wrong][0]:.2g}",
        )
    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True).T
    return np.stack([w, x, y, z], axis=1), translation


def _observations(
    image: np.ndarray | None, point: np.ndarray | None, xy: np.ndarray | None, n_images: int, n_points: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    given = [value is not None for value in (image, point, xy)]
    if not any(given):
        return np.zeros(0, dtype=int), np.zeros(0, dtype=int), np.zeros((0, 2))
    if image is None or point is None or xy is None:
        raise InputError("Observations need an image, a point and a pixel each.", found="some of them")
    image, point, xy = np.asarray(image), np.asarray(point), np.asarray(xy, dtype=float)
    _shape("observed_point", point.shape, image.shape)
    _shape("observed_xy", xy.shape, (len(image), 2))
    _finite("observed_xy", xy)
    for key, index, n in (("observed_image", image, n_images), ("observed_point", point, n_points)):
        if len(index) and not (index.min() >= 0 and index.max() < n):
            raise InputError(
                "An observation is of nothing.",
                key=key,
                expected=f"indices from 0 to {n - 1}",
                found=f"{index.min()} to {index.max()}",
            )
    return image, point, xy


def _check_names(names: Sequence[str], camera_ids: np.ndarray, cameras: Mapping[int, ColmapCamera]) -> None:
    spaced = [name for name in names if name.split() != [name]]
    if spaced:
        raise InputError(
            "COLMAP's text files cannot hold names with spaces, or without a letter.",
            found=", ".join(f"'{name}'" for name in spaced[:3]),
            remedy="rename the images",
        )
    if len(set(names)) != len(names):
        raise InputError("Two images have one name.", remedy="rename one of them")
    unknown = sorted(set(np.asarray(camera_ids).tolist()) - set(cameras))
    if unknown:
        raise InputError(
            "An image is of a camera that is not there.",
            key="camera_ids",
            expected=f"of {', '.join(map(str, sorted(cameras)))}",
            found=", ".join(map(str, unknown)),
        )


def _shape(key: str, found: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if found != expected:
        raise InputError(f"'{key}' has the wrong shape.", key=key, expected=str(expected), found=str(found))


def _finite(key: str, values: np.ndarray) -> None:
    if not np.isfinite(values).all():
        raise InputError(f"'{key}' has numbers that are not finite.", key=key, found="NaN or infinity")
