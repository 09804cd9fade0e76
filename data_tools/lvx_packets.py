"""What Livox writes in its LVX files: layouts of the blocks, and packages to numbers and back.

Everything is little-endian and packed. A package is one datagram of a lidar: a header and as many samples as
its data type says (LVX2: as its length says). A sample is one shot of the laser, with one to three returns.
Sources: Livox's specification of LVX and its SDK (``livox_def.h``); of LVX2, what Livox Viewer 2 reads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from acino_fte.data_tools.recording import GRAVITY, Clock
from acino_fte.errors import InputError

Version = Literal["1.0", "1.1", "2"]
SIGNATURE = b"livox_tech".ljust(16, b"\0")
MAGIC = 0xAC0EA767
DEVICE_NAMES = {
    0: "hub",
    1: "Mid-40",
    2: "Tele-15",
    3: "Horizon",
    6: "Mid-70",
    7: "Avia",
    9: "Mid-360",
    10: "HAP",
}
SAMPLE_NS = {1: 10_000, 2: 4_167, 3: 4_167, 6: 10_000, 7: 4_167, 9: 5_000}
"""Time between two samples by type of device, ns."""
IMU_NS = 5_000_000
"""Time between two inertial samples, ns."""
LINES = {2: 6, 3: 6, 7: 6, 9: 4, 10: 6}
"""Lines of the scan by type of device; a sample's line is its number in the package modulo this."""
FARTHEST_M = 2_000.0
"""No Livox sees so far: points beyond it are no points."""

PUBLIC = np.dtype([("signature", "S16"), ("version", "u1", (4,)), ("magic", "<u4")])
_CODES = [("code", "S16"), ("hub", "S16")]
_EXTRINSICS = [("angles", "<f4", (3,)), ("translation", "<f4", (3,))]
_HEADER_1 = [
    ("index", "u1"),
    ("version", "u1"),
    ("slot", "u1"),
    ("lidar", "u1"),
    ("reserved", "u1"),
    ("error", "<u4"),
    ("clock", "u1"),
    ("kind", "u1"),
    ("stamp", "<u8"),
]
_HEADER_2 = [
    ("version", "u1"),
    ("lidar", "<u4"),
    ("lidar_type", "u1"),
    ("clock", "u1"),
    ("stamp", "<u8"),
    ("counter", "<u2"),
    ("kind", "u1"),
    ("length", "<u4"),
    ("frame_counter", "u1"),
    ("reserved", "<u4"),
]
_CLOCKS_1: dict[int, Clock] = {0: "power_on", 1: "ptp", 3: "gps", 4: "pps"}
_CLOCKS_2: dict[int, Clock] = {0: "power_on", 1: "ptp", 2: "gps"}


@dataclass(frozen=True)
class PacketKind:
    """One data type. `samples` of a package, each with `returns` returns; `unit` m of cartesian numbers.

    `form` is ``"cartesian"``, ``"spherical"`` or ``"imu"``.
    """

    form: str
    samples: int
    returns: int = 1
    tag: bool = True
    unit: float = 1e-3
    number: str = "<i4"

    @cached_property
    def sample(self) -> np.dtype:
        """Layout of one sample."""
        if self.form == "imu":
            return np.dtype([("rate", "<f4", (3,)), ("force", "<f4", (3,))])
        rest = [("reflectivity", "u1")] + ([("tag", "u1")] if self.tag else [])
        angles = [("zenith", "<u2"), ("azimuth", "<u2")]
        if self.form == "cartesian":
            return np.dtype([("returns", [("xyz", self.number, (3,)), *rest], (self.returns,))])
        if self.returns == 1:
            return np.dtype([("depth", "<u4"), *angles, *rest])
        return np.dtype([*angles, ("returns", [("depth", "<u4"), *rest], (self.returns,))])

    @property
    def name(self) -> str:
        """Of the message type: ``livox/cartesian``, ``livox/dual spherical``, ``livox/imu``."""
        return f"livox/{('', '', 'dual ', 'triple ')[self.returns]}{self.form}"


_IMU = PacketKind("imu", 1)
_KINDS_1 = {
    0: PacketKind("cartesian", 100, tag=False),
    1: PacketKind("spherical", 100, tag=False),
    2: PacketKind("cartesian", 96),
    3: PacketKind("spherical", 96),
    4: PacketKind("cartesian", 48, 2),
    5: PacketKind("spherical", 48, 2),
    6: _IMU,
    7: PacketKind("cartesian", 30, 3),
    8: PacketKind("spherical", 30, 3),
}
_FLOATS = PacketKind("cartesian", 100, tag=False, unit=1.0, number="<f4")
_KINDS_2 = {
    0: _IMU,
    1: PacketKind("cartesian", 96),
    2: PacketKind("cartesian", 96, unit=1e-2, number="<i2"),
    3: PacketKind("spherical", 96),
}


@dataclass(frozen=True)
class Layout:
    """The blocks of one version of LVX: headers of file, devices, frames and packages; and data types."""

    version: Version
    number: tuple[int, int, int, int]
    private: np.dtype
    device: np.dtype
    frame_bytes: int
    header: np.dtype
    kinds: dict[int, PacketKind]
    clocks: dict[int, Clock]

    @property
    def imu_kind(self) -> int:
        """The data type of inertial samples."""
        return 0 if self.version == "2" else 6

    def data_start(self, n_devices: int) -> int:
        """Where the first frame begins."""
        return PUBLIC.itemsize + self.private.itemsize + n_devices * self.device.itemsize

    def package(self, kind: int, samples: int | None = None) -> np.dtype:
        """Layout of a whole package of a data type."""
        of = self.kinds[kind]
        return np.dtype([("header", self.header), ("samples", of.sample, (samples or of.samples,))])


_PRIVATE = np.dtype([("duration", "<u4"), ("devices", "u1")])
_TYPE_1 = [("index", "u1"), ("type", "u1")]
LAYOUTS: dict[Version, Layout] = {
    "1.1": Layout(
        "1.1",
        (1, 1, 0, 0),
        _PRIVATE,
        np.dtype([*_CODES, *_TYPE_1, ("enabled", "u1"), *_EXTRINSICS]),
        24,
        np.dtype(_HEADER_1),
        _KINDS_1,
        _CLOCKS_1,
    ),
    "1.0": Layout(
        "1.0",
        (1, 0, 0, 0),
        np.dtype([("devices", "u1")]),
        np.dtype([*_CODES, *_TYPE_1, *_EXTRINSICS]),
        32,
        np.dtype(_HEADER_1),
        _KINDS_1 | {0: _FLOATS},
        _CLOCKS_1,
    ),
    "2": Layout(
        "2",
        (2, 0, 0, 0),
        _PRIVATE,
        np.dtype(
            [*_CODES, ("lidar", "<u4"), ("lidar_type", "u1"), ("type", "u1"), ("enabled", "u1"), *_EXTRINSICS]
        ),
        24,
        np.dtype(_HEADER_2),
        _KINDS_2,
        _CLOCKS_2,
    ),
}


@dataclass(frozen=True)
class LvxDevice:
    """A device as the header of an LVX file names it.

    Attributes
    ----------
    index : int
        Its number in the file: its streams are ``lidar<index>`` and ``imu<index>``.
    code : str
        Broadcast code or serial number.
    type : int, optional
        Of :data:`DEVICE_NAMES`; None when the file does not say it.
    hub : str
        Broadcast code of the hub, or nothing.
    extrinsics_enabled : bool
        Whether the recording program applied the extrinsics on its screen. The returns in the file are not
        moved by them.
    roll, pitch, yaw : float
        rad; :attr:`rotation` is Rz(yaw) Ry(pitch) Rx(roll), lidar to the frame of the recording program.
    translation : tuple of float
        m.
    """

    index: int = 0
    code: str = ""
    type: int | None = 2
    hub: str = ""
    extrinsics_enabled: bool = False
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def type_name(self) -> str:
        """Of :data:`DEVICE_NAMES`."""
        return "unknown" if self.type is None else DEVICE_NAMES.get(self.type, f"type {self.type}")

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3): x = rotation @ x_lidar + translation."""
        (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a), math.cos(a)) for a in (self.roll, self.pitch, self.yaw))
        about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        return about_z @ about_y @ about_x


def decode_points(kind: PacketKind, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples (…,) of a data type to positions (…, R, 3) in m, reflectivities and tags (…, R).

    R returns a sample. Spherical ones: zenith from z, azimuth about z from x, hundredths of a degree.
    """
    inner = samples["returns"] if "returns" in (samples.dtype.names or ()) else samples[..., None]
    reflectivity = inner["reflectivity"]
    tag = inner["tag"] if kind.tag else np.zeros_like(reflectivity)
    if kind.form == "cartesian":
        return inner["xyz"].astype(float) * kind.unit, reflectivity, tag
    depth = inner["depth"] * kind.unit
    zenith, azimuth = (np.radians(samples[name][..., None] / 100.0) for name in ("zenith", "azimuth"))
    across = depth * np.sin(zenith)
    xyz = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), depth * np.cos(zenith)], axis=-1)
    return xyz, reflectivity, tag


def encode_points(kind: PacketKind, xyz: np.ndarray, reflectivity: np.ndarray, tag: np.ndarray) -> np.ndarray:
    """The reverse of :func:`decode_points`, rounded to the steps of the file.

    The returns of one spherical sample share its direction: that of the first one that is there.
    """
    samples = np.zeros(xyz.shape[:-2], kind.sample)
    inner = samples["returns"] if "returns" in (kind.sample.names or ()) else samples[..., None]
    inner["reflectivity"] = reflectivity
    if kind.tag:
        inner["tag"] = tag
    if kind.form == "cartesian":
        steps = xyz if kind.unit == 1.0 else np.rint(xyz / kind.unit)
        reach = np.iinfo(kind.number).max if kind.unit != 1.0 else np.inf
        if np.abs(steps).max(initial=0) > reach:
            raise InputError(
                "A return is too far for this data type.",
                expected=f"at most {reach * kind.unit:.0f} m",
                found=f"{np.abs(xyz).max():.0f} m",
            )
        inner["xyz"] = steps
        return samples
    depth = np.linalg.norm(xyz, axis=-1)
    first = np.take_along_axis(xyz, (depth > 0).argmax(-1)[..., None, None], -2)[..., 0, :]
    zenith = np.degrees(np.arctan2(np.hypot(first[..., 0], first[..., 1]), first[..., 2]))
    azimuth = np.degrees(np.arctan2(first[..., 1], first[..., 0])) % 360.0
    inner["depth"] = np.rint(depth / kind.unit)
    samples["zenith"] = np.rint(zenith * 100)
    samples["azimuth"] = np.rint(azimuth * 100) % 36_000
    return samples


def decode_imu(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inertial samples (K,) to angular velocities (K, 3), rad/s, and specific forces (K, 3), m/s²."""
    return samples["rate"].astype(float), samples["force"].astype(float) * GRAVITY


def encode_imu(rate: np.ndarray, force: np.ndarray) -> np.ndarray:
    """The reverse of :func:`decode_imu`: the file keeps multiples of standard gravity."""
    samples = np.zeros(len(rate), _IMU.sample)
    samples["rate"], samples["force"] = rate, force / GRAVITY
    return samples


def decode_stamps(stamps: np.ndarray, clock: Clock, version: Version) -> np.ndarray:
    """Stamps (K,) uint64 of a file to int64 ns.

    Those of GPS in LVX 1 are a date: year − 2000, month, day, hour (UTC) and microseconds within that hour.
    """
    stamps = np.ascontiguousarray(stamps, dtype="<u8")
    if clock != "gps" or version == "2":
        return stamps.astype(np.int64)
    date = stamps.view("u1").reshape(*stamps.shape, 8)[..., :4].astype(np.int64)
    months = ((date[..., 0] + 30) * 12 + date[..., 1] - 1).astype("datetime64[M]")
    days = months.astype("datetime64[D]").astype(np.int64) + date[..., 2] - 1
    micros = (stamps >> np.uint64(32)).astype(np.int64)
    return ((days * 24 + date[..., 3]) * 3_600_000_000 + micros) * 1_000


def encode_stamps(time_ns: np.ndarray, clock: Clock, version: Version) -> np.ndarray:
    """The reverse of :func:`decode_stamps`; GPS to the microsecond, PPS since the last whole second."""
    time_ns = np.asarray(time_ns, dtype=np.int64)
    if clock == "pps":
        return (time_ns % 1_000_000_000).astype("<u8")
    if clock != "gps" or version == "2":
        return time_ns.astype("<u8")
    hours, within = np.divmod(time_ns // 1_000, 3_600_000_000)
    days, hour = np.divmod(hours, 24)
    months = days.astype("datetime64[D]").astype("datetime64[M]")
    day = days - months.astype("datetime64[D]").astype(np.int64)
    year, month = np.divmod(months.astype(np.int64), 12)
    out = np.zeros((*time_ns.shape, 8), "u1")
    for place, value in enumerate((year - 30, month + 1, day + 1, hour)):
        out[..., place] = value
    out[..., 4:] = within.astype("<u4")[..., None].view("u1")
    return out.view("<u8")[..., 0]
