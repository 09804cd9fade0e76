"""PointCloud2, the point cloud of ROS with any fields, as returns of a lidar, and back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from acino_fte.data_tools.recording import Clock, LidarReturns

_CODES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_TIMES = ("offset_time", "timestamp", "time_stamp", "time", "t", "time_offset", "timeOffset", "stamp")
_INTENSITIES = ("intensity", "intensities", "reflectivity", "i")
_LINES = ("line", "ring", "channel")
_HOUR_NS = 3.6e12


def cloud_from_message(message: dict[str, Any], stamp: int, clock_of: Callable[[int], Clock]) -> LidarReturns:
    """Returns of a PointCloud2: points of any step, fields of any order and offset, either byte order.

    Parameters
    ----------
    message : dict
        Fields of the message.
    stamp : int
        Of its header, ns. A point without a time of its own has this one.
    clock_of : callable
        Tells the clock by a stamp.

    Raises
    ------
    ValueError
        There are no x, y, z, or the data are fewer than the message says.
    """
    points = _points(message)
    names = points.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise ValueError(f"the point cloud has the fields {', '.join(names) or 'none'}, not x, y, z")
    xyz = np.stack([points[axis].astype(float) for axis in "xyz"], axis=1)
    keep = np.isfinite(xyz).all(axis=1) & xyz.any(axis=1)
    times = _first(points, _TIMES)
    time_ns = np.full(len(points), stamp) if times is None else _times(times, stamp)
    intensity, tag, line = (_first(points, n) for n in (_INTENSITIES, ("tag",), _LINES))
    zeros = np.zeros(len(points), np.uint8)
    return LidarReturns(
        time_ns=time_ns[keep],
        xyz=xyz[keep],
        intensity=(zeros if intensity is None else intensity)[keep].astype(float),
        tag=_bytes(zeros if tag is None else tag)[keep],
        line=_bytes(zeros if line is None else line)[keep],
        clock=clock_of(int(time_ns[0]) if len(time_ns) else stamp),
    )


def _first(points: np.ndarray, names: tuple[str, ...]) -> np.ndarray | None:
    found = next((name for name in names if name in (points.dtype.names or ())), None)
    return None if found is None else points[found]


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.nan_to_num(values.astype(float)), 0, 255).astype(np.uint8)


def _points(message: dict[str, Any]) -> np.ndarray:
    """The points as a structured array, (height · width,)."""
    height, width = int(message["height"]), int(message["width"])
    step, row = int(message["point_step"]), int(message["row_step"])
    order = ">" if message["is_bigendian"] else "<"
    names, formats, offsets = [], [], []
    for field in message["fields"]:
        field = field if isinstance(field, dict) else {n: field[n] for n in field.dtype.names}
        code, count, name = _CODES.get(int(field["datatype"])), int(field["count"]), field["name"]
        if code is None or count > 1 or name in names or not name:
            continue  # an array for each point is nothing that is read here
        if int(field["offset"]) + int(code[1]) > step:
            raise ValueError(f"the field {name} lies beyond the {step} bytes of a point")
        names.append(name)
        formats.append(order + code)
        offsets.append(int(field["offset"]))
    data = np.ascontiguousarray(message["data"]).view(np.uint8)
    row = row if row >= width * step else width * step
    if height * width and len(data) < (height - 1) * row + width * step:
        raise ValueError(f"{height} × {width} points of {step} bytes, but only {len(data)} bytes")
    if not height * width or not step:
        return np.zeros(0, [(name, form) for name, form in zip(names, formats, strict=True)])
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    if row == width * step:
        return np.frombuffer(data, dtype, height * width)
    lines = [np.frombuffer(data, dtype, width, offset=i * row) for i in range(height)]
    return np.concatenate(lines)


def _times(values: np.ndarray, stamp: int) -> np.ndarray:
    """Nanoseconds of each point.

    Drivers write a time since the stamp of the header or a time of day, in s, ms, µs or ns, and do not say
    which. A time near the stamp (an hour, or a tenth of a small stamp) is a time of day in that unit. Of the
    others, whole numbers are ns since the stamp; of fractions, those below 1000 are s since the stamp, those
    from 1e8 to 1e11 s of another clock, those above 1e11 ns of another clock, the rest ns since the stamp.
    """
    if not len(values):
        return np.zeros(0, np.int64)
    whole = np.issubdtype(values.dtype, np.integer)
    finite = values if whole else values[np.isfinite(values)]
    middle = float(np.median(finite)) if len(finite) else 0.0
    near = min(_HOUR_NS, stamp / 10)
    unit = next((u for u in (1e9, 1e6, 1e3, 1.0) if abs(middle * u - stamp) < near), None)
    if unit is not None or middle > 1e11:
        return _scaled(values, unit or 1.0)
    if whole:
        return stamp + values.astype(np.int64)
    if 1e8 <= middle <= 1e11:
        return _scaled(values, 1e9)
    return stamp + _scaled(values, 1e9 if np.abs(finite).max(initial=0.0) < 1000 else 1.0)


def _scaled(values: np.ndarray, unit: float) -> np.ndarray:
    """Whole nanoseconds of times in a unit; seconds and their fraction apart, to keep every digit."""
    if np.issubdtype(values.dtype, np.integer):
        return values.astype(np.int64) * int(unit)
    values = np.nan_to_num(values.astype(float), posinf=0.0, neginf=0.0)
    whole = np.floor(values)
    return whole.astype(np.int64) * int(unit) + np.rint((values - whole) * unit).astype(np.int64)


def cloud_to_message(value: LidarReturns) -> dict[str, Any]:
    """Fields of a PointCloud2 as livox_ros_driver2 writes them: 26 bytes a point, with its time in ns."""
    names = ("x", "y", "z", "intensity", "tag", "line", "timestamp")
    datatypes, offsets = (7, 7, 7, 7, 2, 2, 8), (0, 4, 8, 12, 16, 17, 18)
    formats = ["<" + _CODES[code] for code in datatypes]
    points = np.zeros(
        len(value), np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": 26})
    )
    for i, axis in enumerate("xyz"):
        points[axis] = value.xyz[:, i]
    points["intensity"], points["tag"], points["line"] = value.intensity, value.tag, value.line
    points["timestamp"] = value.time_ns
    fields = [
        {"name": name, "offset": offset, "datatype": code, "count": 1}
        for name, offset, code in zip(names, offsets, datatypes, strict=True)
    ]
    return {
        "height": 1,
        "width": len(value),
        "fields": fields,
        "is_bigendian": 0,
        "point_step": 26,
        "row_step": 26 * len(value),
        "data": points.tobytes(),
        "is_dense": 1,
    }
