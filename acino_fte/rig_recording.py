"""A simulated recording in the formats of a real rig: LVX, bags and video, in the clocks of the sensors.

Bags have the topics ``/livox/lidar`` (ten messages a second), ``/livox/imu``, ``/camera/image`` and
``/camera/info``, whose encoders count pan and tilt.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np

from acino_fte.data_tools.recording import ImuSamples, LidarReturns, Picture, PictureInfo
from acino_fte.errors import InputError
from acino_fte.rig_clocks import lidar_clock, received
from acino_fte.rig_lidar import BEAMS, firing_period
from acino_fte.rig_pictures import render_pictures
from acino_fte.simulate_rig import CAMERA, RigSimulation

Recording = Literal["lvx", "bag1", "bag2"]
VideoFormat = Literal["mp4", "mkv"]
RECORDINGS: tuple[Recording, ...] = ("lvx", "bag1", "bag2")
VIDEOS: tuple[VideoFormat, ...] = ("mp4", "mkv")
FILES: dict[Recording, str] = {"lvx": "rig.lvx", "bag1": "rig.bag", "bag2": "rig_ros2"}
ENCODER_COUNTS = 1 << 20  # a turn, of pan and of tilt; half a turn stands for 0
_EXPOSURE_US, _GAIN_DB = 900.0, 6.0
_SERIAL = "3GGDSIM00100091"
_TELE_15 = 2
_LVX_FRAME, _MESSAGE = 0.05, 0.1  # s


def write_recording(
    simulation: RigSimulation,
    folder: Path,
    recording: Recording | None,
    video: VideoFormat | None,
    picture_width: int,
) -> None:
    """Write recordings into a folder that exists: ``rig.lvx``, ``rig.bag`` or ``rig_ros2``, ``cam1.mp4``.

    With them goes ``keypoints.csv``, the detections of the recorded frames: as a detector gives them that was
    run on the pictures, one row for each, whatever was dropped.
    """
    from acino_fte.data_tools.deeplabcut import write_deeplabcut_csv

    kept = np.flatnonzero(~simulation.stamps.dropped)
    write_deeplabcut_csv(
        folder / "keypoints.csv",
        simulation.skeleton.marker_names,
        simulation.detections.position[kept, 0],
        simulation.detections.likelihood[kept, 0],
        scorer="acino_fte_simulation",
    )
    if recording == "lvx":
        _write_lvx(simulation, folder / FILES[recording])
    elif recording:
        _write_bag(simulation, folder / FILES[recording], 1 if recording == "bag1" else 2, picture_width)
    if video:
        from acino_fte.data_tools.video import write_video

        stamps = simulation.stamps.camera_ns[kept] - simulation.stamps.camera_ns[0]
        frames = (picture for _, picture in _recorded(simulation, picture_width))
        write_video(folder / f"{CAMERA}.{video}", frames, simulation.options.fps, stamps_ns=stamps)


def raw_imu(simulation: RigSimulation) -> ImuSamples:
    """The samples of the IMU in the clock of the lidar."""
    imu = simulation.imu
    return ImuSamples(
        lidar_clock(simulation.options, 1e-9 * imu.time_ns), imu.rate, imu.force, clock="power_on"
    )


def raw_returns(simulation: RigSimulation) -> LidarReturns | None:
    """The returns in the clock of the lidar, with the beams they are from as lines.

    Pseudo returns of one frame follow each other at the lidar's pace, as it can measure one at a time only.
    """
    returns, options = simulation.returns, simulation.options
    if returns is None:
        return None
    time_ns = lidar_clock(options, returns.time)
    count = np.round(returns.time / firing_period(options)).astype(np.int64)
    if options.lidar == "pseudo" and len(count):
        count += np.arange(len(count)) - np.searchsorted(returns.time, returns.time)
        time_ns = time_ns[0] + (count - count[0]) * round(1e9 / options.points_per_second)
    line = (count % BEAMS).astype(np.uint8)
    none = np.zeros(len(line), dtype=np.uint8)
    return LidarReturns(time_ns, returns.xyz, returns.intensity, none, line, clock="power_on")


def _recorded(simulation: RigSimulation, width: int) -> Iterator[tuple[int, np.ndarray]]:
    """Frame and picture of every frame that was not dropped."""
    for n, picture in enumerate(render_pictures(simulation, width)):
        if not simulation.stamps.dropped[n]:
            yield n, picture


def _part_of(returns: LidarReturns, part: slice) -> LidarReturns:
    return LidarReturns(
        returns.time_ns[part],
        returns.xyz[part],
        returns.intensity[part],
        returns.tag[part],
        returns.line[part],
        returns.clock,
    )


def _write_lvx(simulation: RigSimulation, path: Path) -> None:
    """Frames of 50 ms with the returns and the inertial samples of that time."""
    from acino_fte.data_tools.lvx_packets import SAMPLE_NS, LvxDevice
    from acino_fte.data_tools.lvx_write import LvxWriter

    if round(1e9 / simulation.options.points_per_second) != SAMPLE_NS[_TELE_15]:
        raise InputError(
            "A Tele-15 measures at one pace only, and its files do not say at which.",
            key="points_per_second",
            expected="240000 for an LVX file",
            found=f"{simulation.options.points_per_second:g}",
            remedy="record a bag instead",
        )
    imu, returns = raw_imu(simulation), raw_returns(simulation)
    step = int(1e9 * _LVX_FRAME)
    first = int(imu.time_ns[0])
    stop = max(int(imu.time_ns[-1]), int(returns.time_ns[-1]) if returns is not None and len(returns) else 0)
    edges = np.arange(first, stop + step + 1, step)
    cuts = np.searchsorted(imu.time_ns, edges)
    hits = np.searchsorted(returns.time_ns, edges) if returns is not None else np.zeros(len(edges), dtype=int)
    with LvxWriter(path, [LvxDevice(index=0, code=_SERIAL, type=_TELE_15)]) as writer:
        for i in range(len(edges) - 1):
            part = slice(cuts[i], cuts[i + 1])
            frame: dict[str, LidarReturns | ImuSamples] = {}
            if returns is not None and hits[i + 1] > hits[i]:
                frame["lidar0"] = _part_of(returns, slice(hits[i], hits[i + 1]))
            if cuts[i + 1] > cuts[i]:
                frame["imu0"] = ImuSamples(imu.time_ns[part], imu.rate[part], imu.force[part], imu.clock)
            writer.write(frame)


def _write_bag(simulation: RigSimulation, path: Path, version: int, width: int) -> None:
    """All records in the order in which the computer received them."""
    from acino_fte.data_tools.bags_write import BagWriter

    lidar, imu = list(_lidar_messages(simulation)), raw_imu(simulation)
    imu_received = received(simulation.options, 1e-9 * simulation.imu.time_ns, "lidar")
    early = [(at, 0, i) for i, (at, _) in enumerate(lidar)] + [
        (at, 1, i) for i, at in enumerate(imu_received.tolist())
    ]
    early.sort(reverse=True)
    with BagWriter(path, version=version) as writer:

        def catch_up(until: float) -> None:
            while early and early[-1][0] <= until:
                at, kind, i = early.pop()
                if kind == 0:
                    writer.write("/livox/lidar", lidar[i][1], at, frame_id="livox_frame")
                else:
                    one = slice(i, i + 1)
                    sample = ImuSamples(imu.time_ns[one], imu.rate[one], imu.force[one], imu.clock)
                    writer.write("/livox/imu", sample, at, frame_id="livox_frame", form="g")

        for n, picture in _recorded(simulation, width):
            at = int(simulation.stamps.received_ns[n])
            catch_up(at)
            info = picture_info(simulation, n)
            image = Picture(info.time_ns, picture, info.number)
            writer.write("/camera/image", image, at, frame_id=CAMERA, form="jpeg")
            writer.write("/camera/info", info, at, frame_id=CAMERA)
        catch_up(np.inf)


def _lidar_messages(simulation: RigSimulation) -> Iterator[tuple[int, LidarReturns]]:
    """When each message of a tenth of a second was received, and its returns."""
    returns = raw_returns(simulation)
    if returns is None or simulation.returns is None or not len(returns):
        return
    time = simulation.returns.time
    edges = np.arange(time[0], time[-1] + _MESSAGE, _MESSAGE)
    ends = np.minimum(edges[1:], time[-1])  # the last message ends with the recording
    at = received(simulation.options, ends, "lidar") if len(ends) else np.zeros(0, dtype=np.int64)
    cuts = np.searchsorted(time, edges)
    cuts[-1] = len(time)
    for i, stamp in enumerate(at.tolist()):
        if cuts[i + 1] > cuts[i]:
            yield stamp, _part_of(returns, slice(cuts[i], cuts[i + 1]))


def picture_info(simulation: RigSimulation, frame: int) -> PictureInfo:
    """What the camera's driver says of a frame; its encoders are zoom, focus, pan and tilt."""
    forward = simulation.true_camera.rotation[frame, 2]
    angles = (np.arctan2(forward[0], forward[1]), np.arcsin(forward[2]))
    counts = [round(float(a) / (2 * np.pi) * ENCODER_COUNTS) + ENCODER_COUNTS // 2 for a in angles]
    stamps = simulation.stamps
    return PictureInfo(
        int(stamps.camera_ns[frame]), int(stamps.number[frame]), _EXPOSURE_US, _GAIN_DB, (0, 0, *counts)
    )
