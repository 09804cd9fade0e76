"""What an import is made of: the streams, pictures and frames of a recording that belong together."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from acino_fte.data_tools.import_pictures import MessagePictures, Pictures, VideoPictures
from acino_fte.data_tools.import_scan import Scan, StreamScan
from acino_fte.data_tools.import_sync import Inputs
from acino_fte.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from acino_fte.data_tools.import_recording import ImportOptions


def gather_inputs(scan: Scan, video: VideoPictures | None, keypoints: Any, options: ImportOptions) -> Inputs:
    """Streams, pictures and the number of frames; InputError where they do not belong together."""
    lidar = scan.choose("lidar", options.lidar_topic, needed=True)
    if lidar is None:
        raise InputError("There is no lidar in the recording.", file=scan.path)
    imu = scan.choose("imu", options.imu_topic)
    _check_camera(scan, options.camera_topic)
    image = scan.choose("image", options.camera_topic)
    info = scan.choose("image_info", options.camera_topic)
    unread = _unread_images(scan, options.camera_topic)
    camera = info if info is not None else image
    pictures: Pictures | None = video
    shown = image if image is not None else unread
    if pictures is None and shown is not None:
        n_messages = len(info) if info is not None else None
        pictures = MessagePictures(scan.path, shown.name, len(shown) or shown.n_values, n_messages)
    n_frames = (
        len(pictures)
        if pictures is not None
        else len(camera or ()) or (keypoints.n_frames if keypoints is not None else 0)
    )
    _check_frames(n_frames, keypoints, video, camera)
    return Inputs(
        lidar, imu, camera, pictures, n_frames, _range(options.frames, n_frames), options.fps,
        options.expected, options.pivot,
    )  # fmt: skip


def _check_camera(scan: Scan, topic: str | None) -> None:
    known = [s.name for s in scan.streams.values() if s.kind in ("image", "image_info")]
    if topic is not None and topic not in known:
        raise InputError(
            f"The recording has no such camera{did_you_mean(topic, known)}",
            file=scan.path,
            key="--camera-topic",
            expected=", ".join(known) or "no camera at all",
            found=topic,
            remedy="see what it holds with --inspect",
        )


def _unread_images(scan: Scan, topic: str | None) -> StreamScan | None:
    """The stream of images that was not decoded, because the driver describes them elsewhere."""
    found = [s for s in scan.streams.values() if s.kind == "image" and not len(s) and s.n_values]
    if topic is not None:
        side = topic.rpartition("/")[0]
        found = [s for s in found if s.name == topic] or [
            s for s in found if s.name.rpartition("/")[0] == side
        ]
    return found[0] if len(found) == 1 else None


def _check_frames(
    n_frames: int, keypoints: Any, video: VideoPictures | None, camera: StreamScan | None
) -> None:
    if n_frames < 2:
        raise InputError(
            "There are no frames: no video, no pictures in the recording, no keypoints.",
            expected="a video (--video), pictures in the recording, or keypoints (--keypoints)",
            found=f"{n_frames} frames",
        )
    if keypoints is not None and keypoints.n_frames != n_frames:
        source = (
            "the video" if video is not None else f"the camera ({camera.name})" if camera else "the recording"
        )
        raise InputError(
            "The keypoints are of another number of frames than the pictures.",
            file=keypoints.path,
            key="--keypoints",
            expected=f"{n_frames} rows, one for every frame of {source}",
            found=f"{keypoints.n_frames} rows",
            remedy="give the video on which the detector was run, with --video",
        )


def _range(frames: tuple[int | None, int | None], n_frames: int) -> tuple[int, int]:
    start, stop = frames[0] or 0, n_frames if frames[1] is None else frames[1]
    if not 0 <= start < stop <= n_frames or stop - start < 2:
        raise InputError(
            "These frames are not in the video.",
            key="--frames",
            expected=f"START:STOP with 0 ≤ START < STOP ≤ {n_frames}, two frames or more",
            found=f"{start}:{stop}",
        )
    return start, stop
