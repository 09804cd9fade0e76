"""Messages of ROS as the shared types of a recording, and back: lidar, inertial, pictures, camera driver.

A decoded message is a dict of its fields (:func:`acino_fte.data_tools.bags_serial.decode`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from acino_fte.data_tools.recording import (
    GRAVITY,
    Clock,
    ImuSamples,
    Kind,
    LidarReturns,
    Picture,
    PictureInfo,
)
from acino_fte.data_tools.ros_clouds import cloud_from_message, cloud_to_message
from acino_fte.data_tools.ros_images import (
    compressed_to_message,
    picture_from_compressed,
    picture_from_image,
    picture_to_message,
)

_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
_CUSTOM = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "CustomPoint[] points\n"
)
_XIMEA_COUNTS = (
    *("size", "bp_size", "frm", "width", "height", "nframe", "tsSec", "tsUSec", "GPI_level", "black_level"),
    *("padding_x", "AbsoluteOffsetX", "AbsoluteOffsetY", "exposure_time_us"),
)
_XIMEA = (
    "std_msgs/Header header\n"
    + "".join(f"uint32 {name}\n" for name in _XIMEA_COUNTS)
    + "float32 gain_db\nuint32 acq_nframe\nuint32 image_user_data\nstring encoders\n"
)
LIVOX_PACKAGES = ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
XIMEA_TYPE = "ximea_ros_cam/msg/XiImageInfo"
DEFINITIONS = {
    **{f"{package}/msg/CustomPoint": _POINT for package in LIVOX_PACKAGES},
    **{f"{package}/msg/CustomMsg": _CUSTOM for package in LIVOX_PACKAGES},
    XIMEA_TYPE: _XIMEA,
}
"""Definitions that bags without their own need; their MD5 sums of ROS 1 are those of the drivers."""

_KINDS: dict[str, Kind] = {
    "sensor_msgs/msg/PointCloud2": "lidar",
    **{f"{package}/msg/CustomMsg": "lidar" for package in LIVOX_PACKAGES},
    "sensor_msgs/msg/Imu": "imu",
    "sensor_msgs/msg/Image": "image",
    "sensor_msgs/msg/CompressedImage": "image",
}
_UNIX_NS = 10**18  # 2001-09-09; no device is on for so long
_BOOT_NS = 10**16  # 115 days
IMU_G_LIMIT = 3.1  # of the norm of an acceleration: half way (in ratio) from 1 to 9.8


def type_name(name: str) -> str:
    """``package/msg/Type`` of ``package/Type``."""
    parts = name.strip().split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name.strip()


def kind_of(name: str) -> Kind:
    """The kind of record that messages of a type become."""
    if name.rsplit("/", 1)[-1] == "XiImageInfo":  # several packages have it
        return "image_info"
    return _KINDS.get(name, "other")


def clock_of(time_ns: int) -> Clock:
    """Which clock a device's stamp is of, by its size: since 1970, or since power-on."""
    if time_ns >= _UNIX_NS:
        return "unix"
    return "power_on" if 0 < time_ns < _BOOT_NS else "unknown"


def stamp_ns(message: dict[str, Any]) -> int:
    """Nanoseconds of the header of a message."""
    stamp = message["header"]["stamp"]
    return int(stamp["sec"]) * 10**9 + int(stamp["nanosec"])


def from_message(
    name: str, message: dict[str, Any], unit: float = 1.0
) -> LidarReturns | ImuSamples | Picture | PictureInfo:
    """One message as a shared type.

    Parameters
    ----------
    name : str
        ``package/msg/Type``, of a kind other than ``"other"``.
    message : dict
        Its fields.
    unit : float
        Of the accelerations of inertial messages, m/s².

    Raises
    ------
    ValueError, KeyError
        The fields do not make sense together, or one is missing.
    """
    short = name.rsplit("/", 1)[-1]
    if short == "PointCloud2":
        stamp = stamp_ns(message)
        return cloud_from_message(message, stamp, clock_of)
    if short == "CustomMsg":
        return _livox(message)
    if short == "Imu":
        return _imu(message, unit)
    if short == "XiImageInfo":
        return _ximea(message)
    stamp = stamp_ns(message)
    read = picture_from_compressed if short == "CompressedImage" else picture_from_image
    return Picture(stamp, read(message))


def _livox(message: dict[str, Any]) -> LidarReturns:
    base = int(message["timebase"]) or stamp_ns(message)
    points = message["points"]
    if isinstance(points, list):  # none or one: not an array
        rows = [tuple(p[f] for f in _POINT_DTYPE.names or ()) for p in points]
        points = np.array(rows, _POINT_DTYPE)
    xyz = np.stack([points[axis].astype(float) for axis in "xyz"], axis=1)
    keep = np.isfinite(xyz).all(axis=1) & xyz.any(axis=1)
    return LidarReturns(
        time_ns=base + points["offset_time"][keep].astype(np.int64),
        xyz=xyz[keep],
        intensity=points["reflectivity"][keep].astype(float),
        tag=points["tag"][keep].astype(np.uint8),
        line=points["line"][keep].astype(np.uint8),
        clock=clock_of(base),
    )


_POINT_DTYPE = np.dtype(
    [(n, "u4" if n == "offset_time" else "f4" if n in "xyz" else "u1") for n in
     ("offset_time", "x", "y", "z", "reflectivity", "tag", "line")]
)  # fmt: skip


def force_norm(message: dict[str, Any]) -> float:
    """Length of the acceleration of an inertial message, in its own unit."""
    return float(np.linalg.norm([message["linear_acceleration"][axis] for axis in "xyz"]))


def _imu(message: dict[str, Any], unit: float) -> ImuSamples:
    stamp = stamp_ns(message)
    rate = np.array([[message["angular_velocity"][axis] for axis in "xyz"]])
    force = np.array([[message["linear_acceleration"][axis] for axis in "xyz"]]) * unit
    return ImuSamples(np.array([stamp]), rate, force, clock_of(stamp))


def _ximea(message: dict[str, Any]) -> PictureInfo:
    """Encoders: the text ``count,a,b,c,d``; its first number is the count of the encoders' own reports."""
    texts = [text for text in message.get("encoders", "").split(",") if text.strip()]
    return PictureInfo(
        time_ns=int(message["tsSec"]) * 10**9 + int(message["tsUSec"]) * 1000,
        number=int(message.get("acq_nframe") or message["nframe"]),
        exposure_us=float(message["exposure_time_us"]),
        gain_db=float(message["gain_db"]),
        encoders=tuple(int(float(text)) for text in texts[1:]),
    )


def header(time_ns: int, frame_id: str, seq: int = 0) -> dict[str, Any]:
    """The header of a message; `seq` is of ROS 1 only."""
    sec, nanosec = divmod(int(time_ns), 10**9)
    return {"seq": seq, "stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame_id}


def to_message(
    value: LidarReturns | ImuSamples | Picture | PictureInfo, frame_id: str, form: str = "", seq: int = 0
) -> tuple[str, dict[str, Any]]:
    """The type and the fields of the message that carries a shared type.

    Parameters
    ----------
    value : LidarReturns, ImuSamples, Picture or PictureInfo
        Of inertial samples one: a message has no more.
    frame_id : str
        Name of the sensor's frame.
    form : str
        Lidar: ``"custom"`` (Livox, default) or ``"pointcloud2"``. Picture: ``"png"`` (default), ``"jpeg"``
        or ``"raw"``. Inertial: ``"m/s2"`` (default) or ``"g"``, as Livox writes.
    seq : int
        Number of the message, for ROS 1.
    """
    if isinstance(value, LidarReturns):
        stamp = int(value.time_ns[0]) if len(value) else 0
        if form == "pointcloud2":
            fields = cloud_to_message(value)
            return "sensor_msgs/msg/PointCloud2", {"header": header(stamp, frame_id, seq), **fields}
        return "livox_ros_driver/msg/CustomMsg", _to_livox(value, header(stamp, frame_id, seq))
    if isinstance(value, ImuSamples):
        return "sensor_msgs/msg/Imu", _to_imu(value, frame_id, 1 / GRAVITY if form == "g" else 1.0, seq)
    if isinstance(value, PictureInfo):
        return XIMEA_TYPE, _to_ximea(value, frame_id, seq)
    head = {"header": header(value.time_ns, frame_id, seq)}
    if form == "raw":
        return "sensor_msgs/msg/Image", head | picture_to_message(value.pixels)
    return "sensor_msgs/msg/CompressedImage", head | compressed_to_message(value.pixels, form or "png")


def _to_livox(value: LidarReturns, head: dict[str, Any]) -> dict[str, Any]:
    points = np.zeros(len(value), _POINT_DTYPE)
    base = int(value.time_ns.min()) if len(value) else 0
    points["offset_time"] = value.time_ns - base
    for i, axis in enumerate("xyz"):
        points[axis] = value.xyz[:, i]
    points["reflectivity"] = np.clip(np.rint(value.intensity), 0, 255)
    points["tag"], points["line"] = value.tag, value.line
    rest = {"point_num": len(points), "lidar_id": 0, "rsvd": [0, 0, 0], "points": points}
    return {"header": head, "timebase": base, **rest}


def _to_imu(value: ImuSamples, frame_id: str, unit: float, seq: int) -> dict[str, Any]:
    if len(value) != 1:
        raise ValueError(f"an inertial message has one sample, not {len(value)}")
    none = np.zeros(9)
    return {
        "header": header(int(value.time_ns[0]), frame_id, seq),
        "orientation": dict.fromkeys("xyzw", 0.0),
        "orientation_covariance": none,
        "angular_velocity": dict(zip("xyz", value.rate[0], strict=True)),
        "angular_velocity_covariance": none,
        "linear_acceleration": dict(zip("xyz", value.force[0] * unit, strict=True)),
        "linear_acceleration_covariance": none,
    }


def _to_ximea(value: PictureInfo, frame_id: str, seq: int) -> dict[str, Any]:
    sec, rest = divmod(int(value.time_ns), 10**9)
    known = {"tsSec": sec, "tsUSec": rest // 1000, "nframe": value.number}
    known["exposure_time_us"] = round(value.exposure_us)
    counts = ",".join(str(n) for n in (value.number, *value.encoders)) if value.encoders else ""
    return {
        "header": header(value.time_ns, frame_id, seq),
        **{name: known.get(name, 0) for name in _XIMEA_COUNTS},
        "gain_db": value.gain_db,
        "acq_nframe": value.number,
        "image_user_data": 0,
        "encoders": counts,
    }
