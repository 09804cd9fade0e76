"""The folder of the rig's recorder as one recording: its segments one after the other, messages and videos.

What the folder holds is told by :mod:`~acino_fte.data_tools.rig_recording`. Nothing in it has to be whole: a
folder without its manifest, with a cut segment or without a video is read as far as it goes.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from acino_fte.data_tools.bags import BagReader
from acino_fte.data_tools.recording import Damage, Kind, Picture, PictureInfo, Record, Stream
from acino_fte.data_tools.rig_pairs import pair_frames
from acino_fte.data_tools.rig_recording import MANIFEST, Manifest, read_manifest
from acino_fte.errors import InputError

_MESSAGES = re.compile(r"messages-(\d+)\.mcap")
_VIDEO = re.compile(r"(.+)-(\d+)\.(mkv|mp4|avi)")
_PLACES = 20


def is_rig_folder(folder: Path) -> bool:
    """Whether a folder is one of the rig's recorder, be its manifest damaged or lost."""
    if not folder.is_dir():
        return False
    if (folder / MANIFEST).is_file():
        with suppress(InputError):
            read_manifest(folder)
            return True
    names = [file.name for file in folder.iterdir()]
    return "metadata.yaml" not in names and any(_MESSAGES.fullmatch(name) for name in names)


@dataclass(frozen=True)
class _Segment:
    """Files of one segment: messages, and videos by camera."""

    index: int
    messages: Path | None
    videos: dict[str, Path]


class RigReader:
    """A recorder's folder as a :class:`~acino_fte.data_tools.recording.RecordingReader`.

    Streams are named by topic. A camera's pictures are the stream ``/cam1/image`` beside ``/cam1/info``: a
    picture comes right after the message that tells of it, and has its stamps and its number. Frame k of a
    segment's video belongs to message k of the segment; where something of either is lost, their times tell
    (:mod:`~acino_fte.data_tools.rig_pairs`). ``received_ns`` is the monotonic clock of the computer,
    ``published_ns`` its wall clock.

    Parameters
    ----------
    folder : Path

    Attributes
    ----------
    manifest : Manifest, optional
        None where it is lost or damaged; :attr:`notes` says so.

    Raises
    ------
    InputError
        It is no folder of the recorder.
    """

    def __init__(self, folder: Path | str) -> None:
        self.path = Path(folder)
        self._notes: list[str] = []
        self.manifest = self._read_manifest()
        self._segments = self._find()
        if self.manifest is None and not self._segments:
            raise InputError(
                "The folder is no recording of the rig.",
                file=self.path,
                expected=f"{MANIFEST} and messages-0000.mcap",
                found="neither",
            )
        self._losses: dict[str, Damage] = {}
        self._closed: dict[str, Damage] = {}  # videos that cannot be opened
        self._rows: dict[tuple[int, str], np.ndarray] = {}
        self._known: dict[int, tuple[Stream, ...]] = {}
        self._lengths: dict[Path, np.ndarray] = {}

    def _read_manifest(self) -> Manifest | None:
        try:
            return read_manifest(self.path)
        except InputError as error:
            self._notes.append(f"{error.problem} The files are taken by their names.")
            return None

    def _find(self) -> list[_Segment]:
        messages: dict[int, Path] = {}
        videos: dict[int, dict[str, Path]] = {}
        if self.path.is_dir():
            for file in sorted(self.path.iterdir()):
                if match := _MESSAGES.fullmatch(file.name):
                    messages[int(match[1])] = file
                elif match := _VIDEO.fullmatch(file.name):
                    videos.setdefault(int(match[2]), {})[match[1]] = file
        indexes = sorted({*messages, *videos})
        return [_Segment(i, messages.get(i), videos.get(i, {})) for i in indexes]

    # What there is ---------------------------------------------------------------

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras that have videos, as ``cam1``."""
        return tuple(sorted({camera for segment in self._segments for camera in segment.videos}))

    @property
    def streams(self) -> tuple[Stream, ...]:
        """Topics with counts; a segment without a sound index is walked through once to find them."""
        found: dict[str, Stream] = {}
        for segment in self._segments:
            for stream in self._streams_of(segment):
                before = found.get(stream.name, replace(stream, count=0))
                found[stream.name] = replace(before, count=(before.count or 0) + (stream.count or 0))
        for camera in self.cameras:
            count = sum(int((self._frames_of(s, camera) >= 0).sum()) for s in self._segments)
            found[_image(camera)] = Stream(_image(camera), "image", "video", count)
        return tuple(found.values())

    def _streams_of(self, segment: _Segment) -> tuple[Stream, ...]:
        if segment.index not in self._known:
            bag = self._bag(segment)
            self._known[segment.index] = bag.streams if bag is not None else ()
        return self._known[segment.index]

    def _bag(self, segment: _Segment) -> BagReader | None:
        if segment.messages is None:
            names = ", ".join(file.name for file in segment.videos.values())
            self._lose(names, Damage(0, 0, 0, ("the segment has no messages; its pictures are left out",)))
            return None
        try:
            return BagReader(segment.messages, imu_unit="m/s2")
        except InputError as error:
            self._lose(segment.messages.name, _unreadable(segment.messages, error))
            return None

    @property
    def damage(self) -> Damage:
        """What was lost so far; complete once all records were read."""
        parts = {**self._missing(), **self._closed, **self._losses}
        places = [f"{name}: {place}" for name, part in parts.items() for place in part.places]
        if len(places) > _PLACES:
            places[_PLACES:] = [f"and {len(places) - _PLACES} more places"]
        return Damage(
            sum(part.n_read for part in parts.values()),
            sum(part.n_lost for part in parts.values()),
            sum(part.bytes_lost for part in parts.values()),
            tuple(places),
        )

    def _missing(self) -> dict[str, Damage]:
        """Files that the manifest names and that are not there."""
        out = {}
        for segment in self.manifest.segments if self.manifest is not None else ():
            if not (self.path / segment.file).is_file():
                lost = sum(segment.counts.values())
                out[segment.file] = Damage(0, lost, segment.n_bytes, ("the file is not there",))
        return out

    @property
    def notes(self) -> tuple[str, ...]:
        """What is odd but cost nothing."""
        return tuple(self._notes)

    def _lose(self, name: str, damage: Damage) -> None:
        self._losses[name] = damage

    # Records ---------------------------------------------------------------------

    def records(
        self, kinds: Collection[Kind] | None = None, streams: Collection[str] | None = None
    ) -> Iterator[Record]:
        """Records in the order of the segments; only those of some kinds and streams, where they are named.

        Videos are decoded only where pictures are asked for.
        """
        self._losses = {}
        for segment in self._segments:
            yield from self._of_segment(segment, kinds, streams)

    def _of_segment(
        self, segment: _Segment, kinds: Collection[Kind] | None, streams: Collection[str] | None
    ) -> Iterator[Record]:
        bag = self._bag(segment)
        if bag is None:
            return
        wanted = [
            camera
            for camera in segment.videos
            if (kinds is None or "image" in kinds) and (streams is None or _image(camera) in streams)
        ]
        videos = {_info(camera): self._pictures_of(segment, camera) for camera in wanted}
        also: set[Kind] | None = None if kinds is None else {*kinds, *(("image_info",) if videos else ())}
        topics = None if streams is None else {*streams, *videos}
        try:
            for record in bag.records(also, topics):
                asked = (kinds is None or record.kind in kinds) and (
                    streams is None or record.stream in streams
                )
                if asked:
                    yield record
                if record.stream in videos and isinstance(record.value, PictureInfo):
                    picture = videos[record.stream].next(record.value)
                    if picture is not None:
                        name = _image(videos[record.stream].camera)
                        yield replace(record, stream=name, kind="image", value=picture)
        finally:
            self._lose(segment.messages.name if segment.messages else "", bag.damage)
            for one in videos.values():
                self._lose(segment.videos[one.camera].name, one.close())

    # Pictures and their messages -------------------------------------------------

    def _pictures_of(self, segment: _Segment, camera: str) -> _Pictures:
        file = segment.videos[camera]
        return _Pictures(camera, file, self._frames_of(segment, camera), self._stamps(file))

    def _stamps(self, file: Path) -> np.ndarray:
        """Times (N,) ns of the frames of a video; none where it cannot be read."""
        if file not in self._lengths:
            from acino_fte.data_tools.video import VideoReader

            try:
                with VideoReader(file) as video:
                    self._lengths[file] = video.stamps_ns
            except InputError as error:
                self._closed[file.name] = _unreadable(file, error)
                self._lengths[file] = np.zeros(0, np.int64)
        return self._lengths[file]

    def _frames_of(self, segment: _Segment, camera: str) -> np.ndarray:
        """(K,) frame of the video that belongs to every message of a camera in a segment; -1 for none."""
        key = segment.index, camera
        if key not in self._rows:
            file = segment.videos.get(camera)
            stamps = self._stamps(file) if file is not None else np.zeros(0, np.int64)
            counts = {stream.name: stream.count or 0 for stream in self._streams_of(segment)}
            n = counts.get(_info(camera), 0)
            if len(stamps) == n and n and self._as_closed(segment, camera, n):
                self._rows[key] = np.arange(n)
            elif not len(stamps) or not n:
                self._rows[key] = np.full(n, -1)
            else:
                started = self.manifest.started_ns if self.manifest is not None else None
                self._rows[key] = pair_frames(stamps, self._logs(segment, camera), started)
        return self._rows[key]

    def _logs(self, segment: _Segment, camera: str) -> np.ndarray:
        """Log times (K,) of a camera's messages in a segment, ns."""
        bag = self._bag(segment)
        records = bag.records(["image_info"], [_info(camera)]) if bag is not None else iter(())
        return np.array([record.received_ns or 0 for record in records], np.int64)

    def _as_closed(self, segment: _Segment, camera: str, n: int) -> bool:
        """Whether both files of a segment hold what the recorder counted when it closed them."""
        if self.manifest is None or self.manifest.state == "recovered":
            return False
        known = {one.file: one.counts for one in self.manifest.segments if one.closed}
        files = {_info(camera): segment.messages, camera: segment.videos[camera]}
        return all(file and known.get(file.name, {}).get(name) == n for name, file in files.items())

    def picture_stamps(self, stream: str) -> np.ndarray:
        """Stamps (N,) int64 of a camera's pictures, ns by its clock: those of their messages."""
        camera, out = _camera(stream), []
        for segment in self._segments:
            frames = self._frames_of(segment, camera)
            bag = self._bag(segment) if (frames >= 0).any() else None
            for k, record in enumerate(bag.records(["image_info"], [_info(camera)]) if bag else ()):
                if k < len(frames) and frames[k] >= 0 and isinstance(record.value, PictureInfo):
                    out.append(record.value.time_ns)
        return np.array(out, np.int64)

    def single_video(self, stream: str) -> Path | None:
        """The video that has all pictures of a camera and no others, where there is one."""
        camera = _camera(stream)
        files = [segment.videos[camera] for segment in self._segments if camera in segment.videos]
        whole = len(files) == 1 and all(
            np.array_equal(frames := self._frames_of(segment, camera), np.arange(len(frames)))
            for segment in self._segments
        )
        return files[0] if whole else None

    def without_picture(self, stream: str) -> tuple[np.ndarray, int]:
        """Rows, among a camera's messages, that have no picture; and how many pictures have no message."""
        camera, first, rows, over = _camera(stream), 0, list[np.ndarray](), 0
        for segment in self._segments:
            frames = self._frames_of(segment, camera)
            rows.append(first + np.flatnonzero(frames < 0))
            first += len(frames)
            if camera in segment.videos:
                over += len(self._stamps(segment.videos[camera])) - int((frames >= 0).sum())
        return np.concatenate(rows) if rows else np.zeros(0, np.int64), over

    def pictures(self, stream: str, which: Sequence[int]) -> Iterator[Picture]:
        """Some pictures of a camera, by their rising numbers from 0, without decoding all before.

        One that does not decode shows the one before it once more.
        """
        from acino_fte.data_tools.video import VideoReader

        camera, first, last = _camera(stream), 0, None
        for segment in self._segments:
            frames = self._frames_of(segment, camera)
            frames = frames[frames >= 0]
            wanted = [int(frames[n - first]) for n in which if first <= n < first + len(frames)]
            first += len(frames)
            if not wanted:
                continue
            with VideoReader(segment.videos[camera]) as video:
                for n in wanted:
                    with suppress(InputError):
                        last = video.at(n)
                    if last is not None:
                        yield last

    def __enter__(self) -> RigReader:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing stays open between records."""


class _Pictures:
    """The pictures of one video, given out as their messages come."""

    def __init__(self, camera: str, file: Path, frames: np.ndarray, stamps: np.ndarray) -> None:
        from acino_fte.data_tools.video import VideoReader

        self.camera, self._frames, self._stamps = camera, frames, stamps
        self._message = self._shown = 0
        self._source: Iterator[Record] = iter(())
        self._next: tuple[int, Picture] | None = None
        self._problem = Damage()
        self._video: VideoReader | None = None
        try:
            self._video = VideoReader(file)
            self._source = self._video.records()
        except InputError as error:
            self._problem = _unreadable(file, error)

    def next(self, info: PictureInfo) -> Picture | None:
        """The picture of the next message, if it is there."""
        k, self._message = self._message, self._message + 1
        frame = int(self._frames[k]) if k < len(self._frames) else -1
        if frame < 0:
            return None
        while self._next is None or self._next[0] < frame:
            record = next(self._source, None)
            if record is None or not isinstance(record.value, Picture):
                return None
            self._next = int(np.searchsorted(self._stamps, record.value.time_ns)), record.value
        if self._next[0] != frame:
            return None
        self._shown += 1
        return Picture(info.time_ns, self._next[1].pixels, info.number)

    def close(self) -> Damage:
        """What was lost of the video; its file is closed."""
        damage = self._problem
        if self._video is not None:
            next(self._source, None)  # behind the last picture it is known what was lost
            damage = self._video.damage
            self._video.close()
        places = list(damage.places)
        bare, over = self._message - self._shown, len(self._stamps) - int((self._frames >= 0).sum())
        if bare > 0:
            places.append(f"{bare} messages have no picture")
        if over > 0:
            places.append(f"{over} pictures have no message and are left out")
        return Damage(self._shown, max(damage.n_lost, bare), damage.bytes_lost, tuple(places))


def _unreadable(file: Path, error: InputError) -> Damage:
    return Damage(0, 0, file.stat().st_size, (error.problem.rstrip("."),))


def _image(camera: str) -> str:
    return f"/{camera}/image"


def _info(camera: str) -> str:
    return f"/{camera}/info"


def _camera(stream: str) -> str:
    return stream.strip("/").rpartition("/")[0]
