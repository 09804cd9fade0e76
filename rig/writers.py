"""Writer threads: one for every sensor, each with a queue that cannot grow beyond its size."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from queue import Full, Queue
from threading import Event as Flag
from threading import Thread
from typing import TYPE_CHECKING, Any

from acino_fte.data_tools.recording import LidarReturns, Picture
from acino_fte.errors import InputError
from acino_fte.rig.sources import Sample, camera_topic

if TYPE_CHECKING:
    from acino_fte.rig.rig_file import CameraPart
    from acino_fte.rig.writers_segments import OpenSegment
    from acino_fte.rig.writers_video import VideoFile

_STOP = object()
_MOST_BAD = 20
_PATIENCE_S = 0.5  # of one try to put something into a full queue


def missing_package(what: str, error: ImportError) -> InputError:
    """The error to raise where a package of the extra ``rig`` is not installed."""
    return InputError(
        f"{what} need a package that is not installed.",
        found=str(error),
        remedy='pip install "acino-fte[rig]"',
    )


@dataclass(frozen=True, eq=False)
class Stamped:
    """A sample, its log time and wall time (ns since 1970), and the counts of the encoders."""

    sample: Sample
    log_ns: int
    wall_ns: int
    counts: tuple[int, ...] = ()


class SensorWriter(Thread):
    """Writes what one sensor delivers: serialises it into the messages of the segment under way.

    Parameters
    ----------
    name : str
        The device.
    size : int
        Of the queue.
    paced : bool
        Wait where the queue is full (virtual clock); else what does not fit is dropped, and counted.
    failed : callable
        Called with the error that ended it, and with those of things that were left out.
    """

    def __init__(self, name: str, size: int, paced: bool, failed: Callable[[Exception], None]) -> None:
        super().__init__(name=f"writer of {name}", daemon=True)
        self.device, self._paced, self._failed = name, paced, failed
        self._queue: Queue[Any] = Queue(size)
        self._segment: OpenSegment | None = None
        self.written: dict[str, int] = {}
        self.broken = False
        self._bad = 0  # in a row, that could not be written

    @property
    def fill(self) -> float:
        """How full the queue is, 0 to 1."""
        return self._queue.qsize() / self._queue.maxsize

    def put(self, item: Stamped) -> bool:
        """Hand over; False where it was dropped."""
        if not self._paced:
            try:
                self._queue.put_nowait(item)
            except Full:
                return False
            return not self.broken
        return self._insist(item)

    def _insist(self, item: Any) -> bool:
        while not self.broken:
            try:
                self._queue.put(item, timeout=_PATIENCE_S)
                return True
            except Full:
                continue
        return False

    def turn_to(self, segment: OpenSegment) -> None:
        """Write what comes from now on into another segment."""
        self._insist(segment)

    def mark(self) -> Flag:
        """Put a mark into the queue: it is set when all before it is written."""
        mark = Flag()
        self._insist(mark)
        return mark

    def wait_for(self, mark: Flag) -> None:
        """Wait until a mark is reached, or writing fails."""
        while not self.broken and not mark.wait(_PATIENCE_S):
            continue

    def finish(self) -> None:
        """Write what is in the queue and end."""
        self._insist(_STOP)
        self.join()

    def run(self) -> None:
        """Until told to finish, or until writing fails."""
        from acino_fte.rig.writers_segments import OpenSegment

        try:
            while (item := self._queue.get()) is not _STOP:
                if isinstance(item, OpenSegment):
                    self._leave()
                    self._segment = item
                elif isinstance(item, Flag):
                    item.set()
                elif self._segment is not None:
                    self._write_one(item, self._segment)
            self._leave()
        except Exception as error:  # noqa: BLE001 - whatever it is, the recorder must know
            self.broken = True
            self._failed(error)
            with suppress(Exception):  # what can still be closed
                self._leave()
            while not self._queue.empty():  # nobody waits for room in a queue that nobody empties
                self._queue.get_nowait()

    def _write_one(self, item: Stamped, segment: OpenSegment) -> None:
        """Write one thing; a few that cannot be, as NaN where a number must be, are told and left out."""
        try:
            self.write(item, segment)
            self._bad = 0
        except (ValueError, TypeError, OverflowError) as error:
            self._bad += 1
            if self._bad > _MOST_BAD or isinstance(error, OSError):
                raise
            self._failed(error)

    def _leave(self) -> None:
        if self._segment is not None:
            segment, self._segment = self._segment, None
            try:
                self.close_files(segment)
            finally:
                segment.left(self.device)

    def write(self, item: Stamped, segment: OpenSegment) -> None:
        """Write one thing."""
        value = item.sample.value
        if not isinstance(value, Picture):
            frame = "livox_frame" if isinstance(value, LidarReturns) else "imu_frame"
            segment.messages.write(item.sample.stream, value, item.log_ns, item.wall_ns, frame)
            self.count(item.sample.stream)

    def close_files(self, segment: OpenSegment) -> None:
        """Close what only this sensor writes into."""

    def count(self, stream: str) -> None:
        """One more was written."""
        self.written[stream] = self.written.get(stream, 0) + 1


class Pace:
    """Keeps writers together where time goes as fast as they can: none falls more than two ticks behind."""

    def __init__(self, writers: Iterable[SensorWriter]) -> None:
        self._writers = list(writers)
        self._marks: list[tuple[SensorWriter, Flag]] = []

    def tick(self) -> None:
        """Wait for what was handed over until the tick before."""
        marks, self._marks = self._marks, [(writer, writer.mark()) for writer in self._writers]
        for writer, mark in marks:
            writer.wait_for(mark)


class CameraWriter(SensorWriter):
    """Writes frames into a video, and what the driver says of each into the messages: always both."""

    def __init__(
        self, name: str, part: CameraPart, codec: str, size: int, paced: bool,
        failed: Callable[[Exception], None],
    ) -> None:  # fmt: skip
        super().__init__(name, size, paced, failed)
        self._part, self._codec = part, codec
        self._video: VideoFile | None = None

    def write(self, item: Stamped, segment: OpenSegment) -> None:
        """Write one frame."""
        from dataclasses import replace

        picture, info = item.sample.value, item.sample.info
        if not isinstance(picture, Picture) or info is None:
            raise TypeError("a camera delivers pictures with what its driver says of them")
        if self._video is None:
            self._video = segment.open_video(self.device, self._part, self._codec, picture.pixels)
        topic, info = camera_topic(self.device), replace(info, encoders=item.counts)
        segment.messages.write(topic, info, item.log_ns, item.wall_ns, self.device)  # first: it may fail
        self._video.write(picture.pixels, item.log_ns)
        self.count(self.device)
        self.count(topic)

    def close_files(self, segment: OpenSegment) -> None:
        """Close the video of the segment."""
        if self._video is not None:
            video, self._video = self._video, None
            segment.close_video(video)
