"""Videos out: in containers that stay readable where a file is cut."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.data_tools.video import load_av
from acino_fte.errors import InputError

_CONTAINERS = {".mkv": "matroska", ".mp4": "mp4", ".avi": "avi"}
_FRAGMENTS = {
    "movflags": "frag_keyframe+empty_moov+default_base_moof",
    "video_track_timescale": "1000000",
}

_CLUSTERS = {"cluster_time_limit": "500"}  # ms: damage costs no more


def write_video(
    path: Path | str,
    frames: Iterable[np.ndarray],
    fps: float,
    stamps_ns: Iterable[int] | None = None,
    codec: str = "libx264",
    quality: int = 18,
    keyframe_every: int = 30,
) -> int:
    """Write a video; it appears whole at the end, or not at all.

    Parameters
    ----------
    path : Path
        ``.mkv`` (times to 1 ms), ``.mp4`` (in fragments, times to 1 µs) or ``.avi`` (constant rate only). The
        first two stay readable where they are cut.
    frames : iterable of (H, W, 3) or (H, W) uint8
        Red, green, blue or grey, all of one size.
    fps : float
        Frames per second.
    stamps_ns : iterable of int, optional
        Time of each frame, ns, rising; the first one becomes zero.
    codec : str
        ``libx264``, ``mpeg4``, or ``ffv1``, which keeps every pixel (``.mkv`` and ``.avi``).
    quality : int
        Constant rate factor of ``libx264``: 0 loses least, 51 most.
    keyframe_every : int
        Frames from one key frame to the next, at most.

    Returns
    -------
    int
        How many frames were written.

    Raises
    ------
    InputError
        The suffix or the codec is not known, there are no frames, or they differ in size.
    """
    path = Path(path)
    form = _CONTAINERS.get(path.suffix.lower())
    if form is None:
        raise InputError(
            "The video cannot be written.", file=path, expected=", ".join(_CONTAINERS), found=path.suffix
        )
    av = load_av()
    rate = Fraction(fps).limit_denominator(1_000_000)
    part = path.with_name(f".{path.name}.writing")
    options = {"mp4": _FRAGMENTS, "matroska": _CLUSTERS}.get(form, {})
    try:
        with av.open(str(part), "w", format=form, options=options) as container:
            settings = {"crf": str(quality)} if codec.startswith("libx26") else {}
            try:
                stream = container.add_stream(codec, rate=rate, options=settings)
            except (ValueError, av.error.FFmpegError) as error:
                raise InputError("The codec is not known.", key=codec, found=str(error)) from error
            stream.codec_context.gop_size = keyframe_every
            if form == "mp4":  # a head that is written first cannot say how late B-frames make the first one
                stream.codec_context.max_b_frames = 0
            n = _write(av, container, stream, frames, stamps_ns, rate, path)
        part.replace(path)
    except av.error.FFmpegError as error:
        raise InputError("The video cannot be written.", file=path, found=str(error)) from error
    finally:
        part.unlink(missing_ok=True)
    return n


def _write(
    av: Any,
    container: Any,
    stream: Any,
    frames: Iterable[np.ndarray],
    stamps_ns: Iterable[int] | None,
    rate: Fraction,
    path: Path,
) -> int:
    base = Fraction(1, 1_000_000) if stamps_ns is not None else 1 / rate
    stamps = iter(stamps_ns) if stamps_ns is not None else count()
    n, shape, first, last = 0, None, None, -1
    for pixels in frames:
        if shape is None:
            shape = pixels.shape
            stream.height, stream.width = shape[:2]
            stream.pix_fmt = _pixel_format(stream.codec_context.name, shape)
            stream.codec_context.time_base = base
        if pixels.shape != shape:
            raise InputError(
                "The frames differ in size.", file=path, key=f"frame {n}", expected=str(shape),
                found=str(pixels.shape),
            )  # fmt: skip
        stamp = next(stamps, None)
        if stamp is None:
            raise InputError("There are fewer times than frames.", file=path, key=f"frame {n}")
        first = stamp if first is None else first
        pts = stamp - first if stamps_ns is None else round((int(stamp) - int(first)) / 1000)
        if pts <= last:
            raise InputError("The times of the frames do not rise.", file=path, key=f"frame {n}")
        frame = av.VideoFrame.from_ndarray(
            np.ascontiguousarray(pixels), format="gray" if pixels.ndim == 2 else "rgb24"
        )
        frame.pts, frame.time_base, last = pts, base, pts
        container.mux(stream.encode(frame))
        n += 1
    if not n:
        raise InputError("There are no frames to write.", file=path)
    container.mux(stream.encode())
    return n


def _pixel_format(codec: str, shape: tuple[int, ...]) -> str:
    if codec == "ffv1":
        return "gray" if len(shape) == 2 else "bgr0"
    return "yuv420p" if shape[0] % 2 == 0 and shape[1] % 2 == 0 else "yuv444p"
