"""COLMAP's binary files as arrays: where each record lies, what it holds, and whether the file is whole.

pycolmap reads the model; its observations and points are Python objects, a million of which take seconds,
and it takes files that end too early for whole. Both are mended here. Layout of the records: COLMAP
documentation, "Output format", "Binary file format".
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from acino_fte.errors import InputError

_COUNT = struct.Struct("<Q")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3BdQ")
_RIG, _SENSOR = struct.Struct("<II"), struct.Struct("<iI?")
_FRAME = struct.Struct("<II7dI")
_REFERENCE, _POSE, _DATUM = 8, 56, 16  # bytes of a rig's first sensor, of a pose, of a frame's image
_RAW_POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
_TRACK_ELEMENT = 8
NO_POINT = np.uint64(2**64 - 1)


@dataclass(frozen=True, eq=False)
class RawImages:
    """The records of ``images.bin`` in its order.

    Attributes
    ----------
    ids : (I,) int
    observations : tuple of (K_i, 3) uint64
        For each image, its points of the model: the bits of x and y (px, double; COLMAP's pixel centres), id.
    """

    ids: np.ndarray
    observations: tuple[np.ndarray, ...]

    def of_images(self, image_ids: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Place in `image_ids` (K,), pixel (K, 2) and id of the point (K,) of all their observations."""
        row = {image_id: i for i, image_id in enumerate(self.ids.tolist())}
        parts = [self.observations[row[image_id]] for image_id in image_ids]
        rows = np.concatenate(parts)
        image = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
        return image, np.ascontiguousarray(rows[:, :2]).view("<f8"), rows[:, 2]


def read_images(path: Path) -> RawImages:
    """The ids and observations of ``images.bin``.

    Raises
    ------
    InputError
        The file is not whole.
    """
    data = path.read_bytes()
    ids, observations = [], []
    try:
        at = _COUNT.size
        for _ in range(_COUNT.unpack_from(data)[0]):
            ids.append(_IMAGE.unpack_from(data, at)[0])
            at = data.index(b"\0", at + _IMAGE.size) + 1
            (n,) = _COUNT.unpack_from(data, at)
            rows = np.frombuffer(data, "<u8", 3 * n, at + _COUNT.size).reshape(n, 3)
            at += _COUNT.size + rows.nbytes
            observations.append(rows[rows[:, 2] != NO_POINT])
    except (struct.error, ValueError, OverflowError) as error:
        raise not_whole(path) from error
    if at != len(data):
        raise not_whole(path)
    return RawImages(np.array(ids, dtype=np.int64), tuple(observations))


def read_points(path: Path) -> np.ndarray:
    """The points of ``points3D.bin`` in its order, structured: id, xyz, rgb, error, length (of its track).

    Raises
    ------
    InputError
        The file is not whole.
    """
    data = path.read_bytes()
    length_at = _POINT.size - _COUNT.size
    offsets = []
    try:
        at = _COUNT.size
        for _ in range(_COUNT.unpack_from(data)[0]):
            offsets.append(at)
            at += _POINT.size + _TRACK_ELEMENT * _COUNT.unpack_from(data, at + length_at)[0]
    except (struct.error, OverflowError) as error:
        raise not_whole(path) from error
    if at != len(data):
        raise not_whole(path)
    raw = np.frombuffer(data, np.uint8)
    places = np.array(offsets, dtype=np.int64)
    points = np.empty(len(places), _RAW_POINT)
    columns = points.view(np.uint8).reshape(len(places), _POINT.size)
    for i in range(_POINT.size):
        columns[:, i] = raw[places + i]
    return points


def check_rigs(path: Path) -> None:
    """Raise InputError when ``rigs.bin`` is not whole."""
    data = path.read_bytes()
    try:
        at = _COUNT.size
        for _ in range(_COUNT.unpack_from(data)[0]):
            n_sensors = _RIG.unpack_from(data, at)[1]
            at += _RIG.size + (_REFERENCE if n_sensors else 0)
            for _ in range(n_sensors - 1):
                at += _SENSOR.size + (_POSE if _SENSOR.unpack_from(data, at)[2] else 0)
    except (struct.error, OverflowError) as error:
        raise not_whole(path) from error
    if at != len(data):
        raise not_whole(path)


def check_frames(path: Path) -> None:
    """Raise InputError when ``frames.bin`` is not whole."""
    data = path.read_bytes()
    try:
        at = _COUNT.size
        for _ in range(_COUNT.unpack_from(data)[0]):
            at += _FRAME.size + _DATUM * _FRAME.unpack_from(data, at)[-1]
    except (struct.error, OverflowError) as error:
        raise not_whole(path) from error
    if at != len(data):
        raise not_whole(path)


def not_whole(path: Path) -> InputError:
    """The error for a file that ends too early, too late, or in nonsense."""
    return InputError(
        "The file of the COLMAP model is not whole.",
        file=path,
        expected="records as COLMAP writes them, up to the last byte",
        found=f"{path.stat().st_size:,} bytes that do not fit them",
        remedy="copy the model again, or export it again with `colmap model_converter`",
    )
