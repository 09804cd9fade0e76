"""Pictures of a recording's camera: of a video, or of messages."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from acino_fte.data_tools.open_recording import open_recording
from acino_fte.data_tools.recording import Picture
from acino_fte.data_tools.rig_reader import RigReader


class VideoPictures:
    """Pictures of a video, by frame."""

    def __init__(self, path: Path) -> None:
        from acino_fte.data_tools.video import VideoReader

        self.path: Path | None = path
        self._reader = VideoReader(path)
        self.stamps_ns: np.ndarray | None = self._reader.stamps_ns
        self.fps: float | None = self._reader.fps
        self.size: tuple[int, int] | None = self._reader.size

    def __len__(self) -> int:
        return len(self._reader)

    def frames(self, start: int, stop: int) -> Iterator[np.ndarray]:
        """Pixels of frames start ≤ n < stop."""
        for n in range(start, stop):
            yield self._reader.at(n).pixels

    def close(self) -> None:
        """Close the file."""
        self._reader.close()


class MessagePictures:
    """Pictures of a stream of a recording, by their order in it.

    Parameters
    ----------
    recording : Path
    stream : str
    count : int
        How many there are.
    n_messages : int, optional
        Of the camera's driver. Where there are more, the pictures' own stamps tell which are without one.
    """

    def __init__(self, recording: Path, stream: str, count: int, n_messages: int | None = None) -> None:
        self.path: Path | None = None
        self.stamps_ns: np.ndarray | None = None
        self.fps: float | None = None
        self.size: tuple[int, int] | None = None
        self._recording, self._stream, self._count = recording, stream, count
        with open_recording(recording) as reader:
            if isinstance(reader, RigReader):
                self.path = reader.single_video(stream)
                if n_messages is not None and n_messages != count:
                    self.stamps_ns = reader.picture_stamps(stream)

    def __len__(self) -> int:
        return self._count

    def frames(self, start: int, stop: int) -> Iterator[np.ndarray]:
        """Pixels of frames start ≤ n < stop."""
        n = 0
        with open_recording(self._recording) as reader:
            if isinstance(reader, RigReader):
                yield from (picture.pixels for picture in reader.pictures(self._stream, range(start, stop)))
                return
            for record in reader.records(kinds=["image"], streams=[self._stream]):
                if n >= stop:
                    return
                if isinstance(record.value, Picture):
                    if n >= start:
                        yield record.value.pixels
                    n += 1

    def close(self) -> None:
        """Nothing stays open."""


Pictures = VideoPictures | MessagePictures


def write_pictures(
    pictures: Pictures, start: int, stop: int, place: np.ndarray, fps: float, target: Path, name: str
) -> str:
    """Write the pictures of a sequence as a video whose frame n is frame n of the sequence; its file name.

    A whole video without gaps is linked or copied. Else it is encoded again, and a dropped frame shows the
    one before it once more.

    Parameters
    ----------
    pictures : Pictures
        The source.
    start, stop : int
        Frames of the source.
    place : (stop - start,) int
        Their frames of the sequence.
    fps : float
        Of the sequence.
    target, name : Path, str
        Folder, and name of the camera.
    """
    whole = start == 0 and stop == len(pictures) and np.array_equal(place, np.arange(len(place)))
    if whole and pictures.path is not None:
        path = target / f"{name}{pictures.path.suffix.lower()}"
        try:
            os.link(pictures.path.resolve(), path)
        except OSError:
            shutil.copyfile(pictures.path, path)
        return path.name
    from acino_fte.data_tools.video import write_video

    path = target / f"{name}.mp4"
    write_video(path, _held(pictures.frames(start, stop), place), fps)
    return path.name


def _held(frames: Iterator[np.ndarray], place: np.ndarray) -> Iterator[np.ndarray]:
    repeats = np.append(np.diff(place), 1)
    for pixels, n in zip(frames, repeats.tolist(), strict=False):
        for _ in range(n):
            yield pixels
