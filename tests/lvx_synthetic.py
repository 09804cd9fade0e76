"""Small LVX recordings for tests, and where their packages lie, by the numbers of the format alone."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from acino_fte.data_tools.lvx_packets import LAYOUTS, LvxDevice
from acino_fte.data_tools.lvx_write import write_lvx
from acino_fte.data_tools.recording import ImuSamples, LidarReturns

SIZES = {0: 1319, 1: 919, 2: 1363, 3: 979, 4: 1363, 5: 787, 6: 43, 7: 1279, 8: 679}
HEADS = {"1.0": (25, 58, 32), "1.1": (29, 59, 24), "2": (29, 63, 24)}  # before devices, a device, a frame
DEFAULT = {"1.0": 0, "1.1": 2, "2": 1}
STEP = 4167
START = 1_000_000_000
CODE = "3GGDJ6K00100101"
DEVICE = LvxDevice(0, CODE, 2)


def frames(
    version="1.1", data_type=None, n_frames=6, per=5, seed=0, clock="power_on", share=0.8, start=START
):
    """Frames of some packages: returns all over the sphere, and inertial samples where the file has them."""
    kind = LAYOUTS[version].kinds[DEFAULT[version] if data_type is None else data_type]
    rng, many = np.random.default_rng(seed), kind.returns
    n = per * kind.samples
    out = []
    for i in range(n_frames):
        time = np.repeat(start + (i * n + np.arange(n)) * STEP, many)
        direction = rng.normal(size=(n, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        xyz = np.repeat(direction, many, axis=0) * rng.uniform(2, 90, (n * many, 1))
        keep = rng.random(n * many) < share
        keep[::many] |= np.arange(n) % kind.samples == 0
        keep[many - 1 :: many] &= keep[::many] if many > 1 else True
        tag = np.tile(np.arange(many, dtype=np.uint8) << 4, n)
        line = np.zeros(len(time), np.uint8)
        returns = LidarReturns(time, xyz, rng.integers(0, 256, n * many), tag, line, clock)
        frame = {"lidar0": chosen(returns, keep)}
        if version != "1.0":
            k = max(1, round(n * STEP / 5e6))
            stamps = start + (i * k + np.arange(k)) * 5_000_000
            frame["imu0"] = ImuSamples(stamps, rng.normal(size=(k, 3)), 9 * rng.normal(size=(k, 3)), clock)
        out.append(frame)
    return out


def chosen(returns: LidarReturns, keep: np.ndarray) -> LidarReturns:
    """Some of the returns."""
    columns = ("time_ns", "xyz", "intensity", "tag", "line")
    return LidarReturns(*(getattr(returns, name)[keep] for name in columns), clock=returns.clock)


def recording(path: Path, version="1.1", **options) -> bytes:
    """A file of such frames; its bytes."""
    write_lvx(path, [DEVICE], frames(version, **options), version=version)
    return path.read_bytes()


def packages(data: bytes, version="1.1", devices=1) -> list[tuple[int, int, int, bool]]:
    """Every package as (start, stop, stamp, whether inertial), by its frames."""
    before, device, head = HEADS[version]
    at, out = before + devices * device, []
    while at < len(data):
        current, following = struct.unpack_from("<QQ", data, at)
        assert current == at
        at += head
        while at < following:
            if version == "2":
                kind, length = data[at + 17], struct.unpack_from("<I", data, at + 18)[0]
                size, stamp, imu = 27 + length, struct.unpack_from("<Q", data, at + 7)[0], kind == 0
            else:
                kind = data[at + 10]
                size, stamp, imu = SIZES[kind], struct.unpack_from("<Q", data, at + 11)[0], kind == 6
            out.append((at, at + size, stamp, imu))
            at += size
    return out


def collected(reader) -> dict[str, dict[str, np.ndarray]]:
    """All values of a recording, stream by stream."""
    parts: dict[str, list] = {}
    for record in reader.records():
        parts.setdefault(record.stream, []).append(record.value)
    out = {}
    for stream, values in parts.items():
        names = [name for name in vars(values[0]) if name != "clock"]
        out[stream] = {name: np.concatenate([getattr(v, name) for v in values]) for name in names}
    return out
