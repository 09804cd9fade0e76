"""Segments of a recording: files of a minute or so, closed when the last writer has left them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from threading import Lock

import numpy as np

from acino_fte.data_tools.rig_recording import Segment
from acino_fte.rig.rig_file import CameraPart
from acino_fte.rig.writers_messages import MessageFile
from acino_fte.rig.writers_video import VideoFile


class OpenSegment:
    """One segment while it is written.

    Parameters
    ----------
    folder : Path
    index : int
        From 0.
    started_ns : int
        Log time of the start of the recording.
    writers : set of str
        Devices that write into it.
    tell : callable
        Called with what is known of a file: when it begins, and when it is closed.
    """

    def __init__(
        self, folder: Path, index: int, started_ns: int, writers: set[str], tell: Callable[[Segment], None]
    ) -> None:
        self.index, self._folder, self._started = index, folder, started_ns
        self._writers, self._tell, self._lock = set(writers), tell, Lock()
        self._videos: dict[str, VideoFile] = {}
        self.closed = False
        path = folder / f"messages-{index:04d}.mcap"
        tell(Segment(path.name, "messages", index))
        self.messages = MessageFile(path)

    def open_video(self, camera: str, part: CameraPart, codec: str, pixels: np.ndarray) -> VideoFile:
        """Begin the video of a camera."""
        path = self._folder / f"{camera}-{self.index:04d}.mkv"
        self._tell(Segment(path.name, "video", self.index))
        video = VideoFile(path, camera, part, codec, self._started, pixels)
        with self._lock:
            self._videos[camera] = video
        return video

    def close_video(self, video: VideoFile) -> None:
        """Close the video of a camera."""
        video.close()
        with self._lock:
            del self._videos[video.camera]
        self._tell(
            Segment(
                video.path.name, "video", self.index, True, video.first_ns, video.last_ns,
                {video.camera: video.count}, video.path.stat().st_size,
            )
        )  # fmt: skip

    def left(self, writer: str) -> None:
        """A writer has turned to the next segment; the last one closes the messages."""
        with self._lock:
            self._writers.discard(writer)
            if self._writers:
                return
        self.close()

    def close(self) -> None:
        """Close the messages, once."""
        with self._lock:
            if self.closed:
                return
            self.closed = True
        messages = self.messages
        messages.close()
        self._tell(
            Segment(
                messages.path.name, "messages", self.index, True, messages.first_ns, messages.last_ns,
                dict(messages.counts), messages.path.stat().st_size,
            )
        )  # fmt: skip

    def flush(self) -> None:
        """Hand what was written to the operating system."""
        self.messages.flush()

    def sync(self) -> None:
        """Have the disk hold it."""
        with self._lock:
            videos = list(self._videos.values())
        for file in (self.messages, *videos):
            file.sync()
