"""Videos with PyAV: streamed, or any frame by its number. Written by :mod:`video_write`."""

from __future__ import annotations

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.data_tools.recording import Damage, Kind, Picture, Record, Stream
from acino_fte.data_tools.video_cut import is_cut
from acino_fte.errors import InputError
from acino_fte.extras import missing_package

VIDEO_SUFFIXES = (".mp4", ".mkv", ".avi", ".mov", ".m4v", ".webm", ".mpg", ".mpeg", ".mts", ".ts", ".wmv")
_CACHE_BYTES = 64 << 20  # of decoded frames about the last one asked for
_CACHE_FRAMES = 16
_PLACES = 20  # of damage that are told one by one
_GREY = {"gray": "gray", "gray10le": "gray16le", "gray12le": "gray16le", "gray16le": "gray16le"}


def load_av() -> Any:
    """The package ``av``, or an error that names the remedy."""
    try:
        import av
        import av.error
    except ImportError as error:
        raise missing_package("Videos", error) from error
    av.logging.set_level(None)  # damage is reported by the reader, not on the terminal
    return av


class VideoReader:
    """The first video stream of a file: a :class:`~acino_fte.data_tools.recording.RecordingReader`.

    Frames are counted from 0 in the order they are shown. Of a cut or damaged file those that decode are
    read, and :attr:`damage` counts the others. A turn in the file's metadata (telephones) is applied.

    Parameters
    ----------
    path : Path
        Whatever FFmpeg reads.

    Raises
    ------
    InputError
        There is no such file, or no video stream in it.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._av = load_av()
        self._cache: OrderedDict[int, Picture] = OrderedDict()
        self._stamps: list[int] | None = None  # of all frames, as shown
        self._keys: list[int] = []
        self._damage = Damage()
        self._frames: Iterator[Any] | None = None  # of the last seek
        self._last = -1  # number of the last frame that came from there
        self._container, self._stream = self._open()

    def _open(self) -> tuple[Any, Any]:
        if not self.path.is_file():
            found = "a folder" if self.path.is_dir() else "nothing"
            raise InputError("There is no such video.", file=self.path, expected="a video", found=found)
        try:
            container = self._av.open(str(self.path))
        except (self._av.error.FFmpegError, ValueError) as error:
            raise InputError(
                "The video cannot be read.",
                file=self.path,
                expected="MP4, Matroska, AVI or another file that FFmpeg reads",
                found=_why_not(error, self.path),
                remedy="an MP4 that was cut before its end has no index: restore it with a sound file of the "
                "same camera",
            ) from error
        if not container.streams.video:
            container.close()
            raise InputError("The file has no pictures.", file=self.path, expected="a video stream")
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        return container, stream

    @property
    def fps(self) -> float | None:
        """Frames per second, on average, as the file says."""
        rate = self._stream.average_rate or self._stream.guessed_rate
        return float(rate) if rate else None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px, before a turn."""
        return self._stream.codec_context.width, self._stream.codec_context.height

    @property
    def streams(self) -> tuple[Stream, ...]:
        """One stream of images, with the count of the file's head."""
        return (Stream("video0", "image", self._stream.codec_context.name, self._stream.frames or None),)

    @property
    def damage(self) -> Damage:
        """What was lost so far; complete once all records were read."""
        return self._damage

    @property
    def stamps_ns(self) -> np.ndarray:
        """Times (N,) int64 of all frames by the clock of the file, ns. Walks through the file, undecoded."""
        base = self._stream.time_base
        return np.array([round(stamp * base * 10**9) for stamp in self._index()], np.int64)

    def __len__(self) -> int:
        return len(self._index())

    def __enter__(self) -> VideoReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._frames = None
        self._container.close()

    def records(
        self, kinds: Collection[Kind] | None = None, streams: Collection[str] | None = None
    ) -> Iterator[Record]:
        """All frames from the first one on, as they are shown."""
        if (kinds is not None and "image" not in kinds) or (streams is not None and "video0" not in streams):
            return
        container, stream = self._open()
        try:
            for number, frame in enumerate(self._decoded(container, stream)):
                yield Record("video0", "image", None, self._picture(frame, number))
        finally:
            container.close()

    def _decoded(self, container: Any, stream: Any) -> Iterator[Any]:
        """Sound frames; counts the others."""
        read, lost, size, places, last = 0, 0, 0, list[str](), None
        for packet, frames, problem in self._packets(container, stream):
            if problem is not None:
                lost, size = lost + 1, size + (packet.size if packet is not None else 0)
                places.append(f"after frame {read - 1}: {problem}")
            for frame in frames:
                if frame.is_corrupt:
                    lost += 1
                    places.append(f"after frame {read - 1}: a frame that is not whole")
                    continue
                read, last = read + 1, frame
                self._damage = Damage(read, lost, size, tuple(places[:_PLACES]))
                yield frame
        places += self._missing(stream, read, last)
        lost = max(lost, (stream.frames or 0) - read)
        self._damage = Damage(read, lost, size, tuple(places[:_PLACES]))

    def _packets(self, container: Any, stream: Any) -> Iterator[tuple[Any, list[Any], str | None]]:
        """Packets with the frames that come out, or with what is wrong."""
        errors = (self._av.error.FFmpegError, ValueError)
        packets = container.demux(stream)
        while True:
            try:
                packet = next(packets)
            except StopIteration:
                return
            except errors as error:
                yield None, [], f"the file ends in a block ({error})"
                packets = iter(())
                packet = None  # what the decoder still holds
            try:
                yield packet, stream.codec_context.decode(packet), None
            except self._av.error.EOFError:
                return
            except errors as error:
                yield packet, [], f"{packet.size if packet is not None else 0} bytes do not decode ({error})"

    def _missing(self, stream: Any, read: int, last: Any) -> list[str]:
        """Sentences on a file that ends before its head says."""
        if is_cut(self.path):
            return [f"the file is cut after frame {read - 1}"]
        if stream.frames and read < stream.frames:
            return [f"the head of the file says {stream.frames} frames, {read} were read"]
        total = self._container.duration
        if total and last is not None and last.pts is not None and self.fps:
            end = float(last.pts * stream.time_base) + 1 / self.fps
            if total / 1e6 - end > max(0.5, 3 / self.fps):
                return [f"the head of the file says {total / 1e6:.2f} s, the pictures end at {end:.2f} s"]
        return []

    def _picture(self, frame: Any, number: int) -> Picture:
        base = frame.time_base or self._stream.time_base
        time_ns = round(frame.pts * base * 10**9) if frame.pts is not None else 0
        pixels = frame.to_ndarray(format=_GREY.get(frame.format.name, "rgb24"))
        turns = round(frame.rotation / 90) % 4
        return Picture(time_ns, np.ascontiguousarray(np.rot90(pixels, turns)) if turns else pixels, number)

    # Any frame by its number -------------------------------------------------

    def _index(self) -> list[int]:
        """Presentation stamps of all frames in order, in units of the stream's time base."""
        if self._stamps is None:
            container, stream = self._open()
            stamps, keys = [], []
            errors = (self._av.error.FFmpegError, ValueError)
            try:
                for packet in container.demux(stream):
                    if packet.size and packet.pts is not None and not packet.is_discard:
                        stamps.append(packet.pts)
                        if packet.is_keyframe:
                            keys.append(packet.pts)
                    elif packet.size and packet.pts is None:
                        stamps = self._decoded_stamps()
                        break
            except errors:
                pass  # a cut file: the packets before
            finally:
                container.close()
            self._stamps, self._keys = sorted(set(stamps)), sorted(set(keys))
        return self._stamps

    def _decoded_stamps(self) -> list[int]:
        """Stamps of a file whose packets have none: those of its decoded frames."""
        container, stream = self._open()
        try:
            return [
                f.pts
                for _, frames, _ in self._packets(container, stream)
                for f in frames
                if f.pts is not None
            ]
        finally:
            container.close()

    def at(self, frame: int) -> Picture:
        """The frame of this number, exactly, whatever the frame rate and the order in the file.

        Raises
        ------
        InputError
            There is no such frame, or it does not decode.
        """
        stamps = self._index()
        if not 0 <= frame < len(stamps):
            raise InputError(
                "The video has no such frame.",
                file=self.path,
                key=f"frame {frame}",
                expected=f"0 to {len(stamps) - 1}",
            )
        if frame in self._cache:
            self._cache.move_to_end(frame)
            return self._cache[frame]
        found = self._forward(frame) if self._continues(frame) else None
        found = found or self._forward(frame, seek=True) or self._forward(frame, restart=True)
        if found is None:
            raise InputError("The frame does not decode.", file=self.path, key=f"frame {frame}")
        return found

    def _continues(self, frame: int) -> bool:
        """Whether going on from the last frame is no longer than starting at a key frame."""
        if self._frames is None or self._last < 0 or frame <= self._last:
            return False
        stamps = self._index()
        return bisect_right(self._keys, stamps[frame]) == bisect_right(self._keys, stamps[self._last])

    def _forward(self, frame: int, seek: bool = False, restart: bool = False) -> Picture | None:
        """Decode up to the frame: onwards, from its key frame, or from the start of the file."""
        stamps = self._index()
        if seek or restart:
            self._frames = self._from(stamps[frame], restart)
        while self._frames is not None:
            decoded = next(self._frames, None)
            if decoded is None or decoded.pts is None:
                self._frames = None
                return None
            number = bisect_right(stamps, decoded.pts) - 1
            if decoded.is_corrupt or number < 0 or stamps[number] != decoded.pts:
                continue
            self._last = number
            if number > frame:
                return None
            if number > frame - 4:  # those just before are asked for next, when going back
                self._keep(number, self._picture(decoded, number))
            if number == frame:
                return self._cache[frame]
        return None

    def _from(self, stamp: int, restart: bool) -> Iterator[Any]:
        """Frames from the key frame at or before a stamp, or from the start."""
        place = bisect_right(self._keys, stamp) - 1
        errors = (self._av.error.FFmpegError, ValueError)
        try:
            if restart or place < 0:
                raise ValueError("from the start")
            self._container.seek(self._keys[place], stream=self._stream, backward=True)
            self._stream.codec_context.flush_buffers()
        except errors:
            self._container.close()
            self._container, self._stream = self._open()
        for _, frames, _ in self._packets(self._container, self._stream):
            yield from frames

    def _keep(self, number: int, picture: Picture) -> None:
        self._cache[number] = picture
        while len(self._cache) > 1 and (
            len(self._cache) > _CACHE_FRAMES
            or len(self._cache) * picture.pixels.nbytes > max(_CACHE_BYTES, 2 * picture.pixels.nbytes)
        ):
            self._cache.popitem(last=False)


def _why_not(error: Exception, path: Path) -> str:
    """What is wrong with a file that FFmpeg does not open."""
    if path.stat().st_size == 0:
        return "an empty file"
    return getattr(error, "strerror", None) or str(error) or type(error).__name__


def __getattr__(name: str) -> Any:
    """``write_video`` lives in its own module; it is offered here too."""
    if name == "write_video":
        from acino_fte.data_tools.video_write import write_video

        return write_video
    raise AttributeError(name)
