"""Video of a segment: Matroska, in clusters so short that little is lost in a crash."""

from __future__ import annotations

import os
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from acino_fte.rig.rig_file import CameraPart
from acino_fte.rig.writers import missing_package

HARDWARE = ("h264_nvenc", "h264_v4l2m2m", "h264_vaapi", "h264_videotoolbox")
SOFTWARE, RAW, LOSSLESS = "libx264", "rawvideo", "ffv1"
"""Lossless is for what Matroska does not take raw: colours, grey of more than 8 bits."""
CLUSTER_MS = 200
_OPTIONS = {"libx264": {"preset": "ultrafast", "tune": "zerolatency"}, "h264_nvenc": {"zerolatency": "1"}}
_TRIAL = 5  # frames that an encoder must give back
_BASE = Fraction(1, 1000)  # s; Matroska keeps ms


def load_av() -> Any:
    """The package ``av``, quiet."""
    try:
        import av
        import av.error
    except ImportError as error:
        raise missing_package("Videos", error) from error
    av.logging.set_level(None)
    return av


def choose_codec(part: CameraPart) -> str:
    """The encoder for a camera's video: one in the hardware that gives back every frame, else x264."""
    if part.codec == "raw":
        return RAW if part.bits <= 8 else LOSSLESS
    return next((name for name in HARDWARE if _works(name, part)), SOFTWARE)


def _works(name: str, part: CameraPart) -> bool:
    """Whether an encoder takes pictures of this size and gives every one back."""
    av = load_av()
    try:
        context = av.CodecContext.create(name, "w")
        _set_up(context, part, name)
        context.width, context.height = part.width, part.height
        grey = np.zeros((part.height, part.width), np.uint8)
        packets = 0
        for i in range(_TRIAL):
            packets += len(context.encode(_frame(av, grey, i, context.pix_fmt)))
        packets += len(context.encode(None))
    except (av.error.FFmpegError, ValueError, TypeError, RuntimeError):
        return False
    return packets == _TRIAL


def _set_up(context: Any, part: CameraPart, name: str) -> None:
    """Settings of an encoder: low delay, a key frame a second, the rate of the rig."""
    if name in (RAW, LOSSLESS):
        context.pix_fmt = "gray" if part.bits <= 8 else "gray16le"
    else:
        even = part.width % 2 == 0 and part.height % 2 == 0
        context.pix_fmt = "yuv420p" if even else "yuv444p"
        context.color_range = 2  # full: grey values stay what they are
        context.max_b_frames = 0
        context.gop_size = max(round(part.fps), 1)
        context.bit_rate = round(part.bitrate_mbit * 1e6)
        context.options = dict(_OPTIONS.get(name, {}))
    context.time_base = _BASE
    context.framerate = Fraction(part.fps).limit_denominator(1000)


def _frame(av: Any, pixels: np.ndarray, pts: int, form: str) -> Any:
    """A frame of FFmpeg: grey pixels become luma as they are, colours are converted."""
    if pixels.ndim == 3:
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24").reformat(format=form)
    elif form.startswith("gray"):
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format=form)
    else:
        grey = pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)
        frame = av.VideoFrame(grey.shape[1], grey.shape[0], form)
        for i, plane in enumerate(frame.planes):
            table = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
            table[:, : plane.width] = grey if i == 0 else 128
    frame.pts, frame.time_base = pts, _BASE
    return frame


class VideoFile:
    """One video, written by one thread.

    The time of a frame in it is its log time since the start of the recording, ms, and never that of the
    frame before.

    Parameters
    ----------
    path : Path
    camera : str
    part : CameraPart
    codec : str
        Of :func:`choose_codec`.
    started_ns : int
        Log time of the start of the recording.
    pixels : (H, W) or (H, W, 3)
        The first frame.
    """

    def __init__(
        self, path: Path, camera: str, part: CameraPart, codec: str, started_ns: int, pixels: np.ndarray
    ) -> None:
        self._av = load_av()
        self.path, self.camera, self._started = path, camera, started_ns
        self._file = path.open("xb", buffering=0)
        self._lock, self._closed, self._last = Lock(), False, -1
        self.count = 0
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        options = {"cluster_time_limit": str(CLUSTER_MS), "flush_packets": "1"}
        self._container = self._av.open(self._file, "w", format="matroska", options=options)
        codec = LOSSLESS if codec == RAW and pixels.ndim == 3 else codec
        rate = Fraction(part.fps).limit_denominator(1000)
        self._stream = self._container.add_stream(codec, rate=rate)
        self._stream.width, self._stream.height = pixels.shape[1], pixels.shape[0]
        _set_up(self._stream.codec_context, part, codec)
        if pixels.ndim == 3 and codec == LOSSLESS:
            self._stream.codec_context.pix_fmt = "bgr0"
        self._form = self._stream.codec_context.pix_fmt

    def write(self, pixels: np.ndarray, log_ns: int) -> None:
        """Write one frame."""
        pts = max(round((log_ns - self._started) * 1e-6), self._last + 1)
        frame = _frame(self._av, pixels, pts, self._form)
        for packet in self._stream.encode(frame):
            self._container.mux(packet)
        self._last, self.count = pts, self.count + 1
        self.first_ns = log_ns if self.first_ns is None else self.first_ns
        self.last_ns = log_ns

    def sync(self) -> None:
        """Have the disk hold what the operating system was given."""
        with self._lock:
            if self._closed:
                return
            own = os.dup(self._file.fileno())
        try:
            os.fsync(own)
        finally:
            os.close(own)

    def close(self) -> None:
        """Write what the encoder holds, and the index; on the disk afterwards."""
        with self._lock:
            self._closed = True
        try:
            for packet in self._late():
                self._container.mux(packet)
            self._container.close()
            os.fsync(self._file.fileno())
        finally:
            self._file.close()

    def _late(self) -> Iterator[Any]:
        if self.count:
            yield from self._stream.encode(None)
