"""One walk through a recording that keeps what a check needs to know of it, in constant memory."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from acino_fte.data_tools.bags import BagReader
from acino_fte.data_tools.lvx import LvxReader
from acino_fte.data_tools.open_recording import open_recording
from acino_fte.data_tools.recording import (
    Damage,
    ImuSamples,
    Kind,
    LidarReturns,
    Picture,
    PictureInfo,
    Record,
    RecordingReader,
)
from acino_fte.data_tools.rig_reader import RigReader
from acino_fte.data_tools.rig_recording import Manifest
from acino_fte.rig.check_camera import MOST, Brightness, CameraCheck
from acino_fte.rig.check_stamps import StampCheck
from acino_fte.rig.check_types import CameraAccount, Gap, StreamAccount, TimeBase, Warned
from acino_fte.rig.check_wall import WallAccount, WallClock, wall_account

SAMPLED = 24
"""Pictures of a camera that are decoded to tell how bright they are."""
_SPARSE_NS = 500_000_000
_HOLE_NS = 1_700_000  # between returns: datagrams of 0.4 ms are missing (livox_ros_driver)
_DATAGRAM_NS = 400_032
_THIN = 0.5  # of the usual number of returns
_TOLD = 5000  # records between two reports of progress
Tell = Callable[[str], None]


@dataclass
class LidarAccount:
    """Returns of a lidar's messages: usual number, thin messages, holes of lost datagrams.

    `holes_judged`: whether holes are rare enough to be losses rather than the sky.
    """

    name: str
    returns: float = 0.0
    thin: list[int] = field(default_factory=list)
    n_thin: int = 0
    n: int = 0
    datagrams_lost: int = 0
    holes: list[int] = field(default_factory=list)
    holes_judged: bool = False


@dataclass
class Findings:
    """All that a walk found.

    Attributes
    ----------
    path : Path
    kind : str
        ``"rig"``, ``"bag"``, ``"lvx"`` or ``"video"``.
    base : {"computer", "device"}
        Whose clock the times are of.
    streams, cameras, lidars : dict
        By the names of the streams.
    wall : WallAccount
    warned : list of Warned
    damage : Damage
        Without what the streams' losses tell already.
    notes : list of str
    manifest : Manifest, optional
    health_told : bool
        Whether the format says how the lidar is.
    """

    path: Path
    kind: str
    base: TimeBase
    streams: dict[str, StreamAccount] = field(default_factory=dict)
    cameras: dict[str, CameraAccount] = field(default_factory=dict)
    lidars: dict[str, LidarAccount] = field(default_factory=dict)
    wall: WallAccount = field(default_factory=WallAccount)
    warned: list[Warned] = field(default_factory=list)
    damage: Damage = field(default_factory=Damage)
    notes: list[str] = field(default_factory=list)
    manifest: Manifest | None = None
    health_told: bool = False

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last time of all streams, ns; of a recorder's folder from when it was started."""
        filled = [s for s in self.streams.values() if s.first_ns is not None and s.last_ns is not None]
        if not filled:
            return None
        first = min(s.first_ns or 0 for s in filled)
        last = max(s.last_ns or 0 for s in filled)
        if self.manifest is not None:
            first = min(first, self.manifest.started_ns)
        return first, last


def walk_recording(path: Path | str, tell: Tell | None = None, every_frame: bool = False) -> Findings:
    """Walk through a recording.

    Parameters
    ----------
    path : Path
        Whatever :func:`~acino_fte.data_tools.open_recording.open_recording` reads.
    tell : callable, optional
        Is told how far it is.
    every_frame : bool
        Decode every picture of a video; else some, and the others are only counted.

    Raises
    ------
    InputError
        There is no such recording.
    """
    with open_recording(path) as reader:
        if isinstance(reader, RigReader):
            return _Walk(reader, Path(path), "rig", tell, every_frame).run()
        if isinstance(reader, LvxReader):
            return _Walk(reader, Path(path), "lvx", tell, every_frame).run()
        if isinstance(reader, BagReader):
            return _Walk(reader, Path(path), "bag", tell, True).run()
        return _Walk(reader, Path(path), "video", tell, every_frame).run()


class _Walk:
    """One walk under way."""

    def __init__(
        self, reader: RecordingReader, path: Path, kind: str, tell: Tell | None, every_frame: bool
    ) -> None:
        self.reader, self.tell, self.every_frame = reader, tell, every_frame
        base: TimeBase = "computer" if kind in ("rig", "bag") else "device"
        self.found = Findings(path, kind, base)
        self._stamps: dict[str, StampCheck] = {}
        self._cameras: dict[str, CameraCheck] = {}
        self._bright: dict[str, tuple[Brightness, list[int]]] = {}
        self._returns: dict[str, tuple[array, array, array]] = {}
        self._walls: dict[str, WallClock] = {}
        self._bare: dict[str, set[int]] = {}
        self._expected: dict[str, float] = {}
        self._lens: list[tuple[int, str, float]] = []

    def run(self) -> Findings:
        """Walk, and account for everything."""
        found, reader = self.found, self.reader
        for stream in reader.streams:
            if stream.kind != "other":
                found.streams[stream.name] = StreamAccount(stream.name, stream.kind)
        if isinstance(reader, RigReader):
            self._prepare(reader)
        if found.kind == "video" and not self.every_frame:
            self._plain_video()
        else:
            kinds: set[Kind] = {"lidar", "imu", "image_info"}
            if self.every_frame:
                kinds.add("image")
            for n, record in enumerate(reader.records(kinds=kinds)):
                self._take(record)
                if self.tell is not None and n % _TOLD == _TOLD - 1:
                    self.tell(f"checking: {n + 1} messages")
        for check in self._stamps.values():
            check.finish()
        for camera in self._cameras.values():
            camera.finish()
        found.notes += getattr(reader, "notes", ())
        found.damage = reader.damage if found.kind != "video" or self.every_frame else found.damage
        self._close()
        return found

    def _prepare(self, reader: RigReader) -> None:
        """What the folder itself says is to be expected."""
        from acino_fte.rig.check_lens import lens_tolerances

        manifest = self.found.manifest = reader.manifest
        self._lens = lens_tolerances(reader.path)
        for stream in manifest.streams if manifest is not None else ():
            self._expected[stream.name] = stream.expected_hz
            name = f"/{stream.name}/image" if stream.kind == "image" else stream.name
            kind = stream.kind
            account = self.found.streams.setdefault(name, StreamAccount(name, kind))
            account.expected_hz = stream.expected_hz
        for camera in reader.cameras:
            rows, over = reader.without_picture(f"/{camera}/image")
            self._bare[f"/{camera}/info"] = set(rows[:MOST].tolist())
            account_ = self._camera(f"/{camera}/info")
            account_.n_without, account_.without_message = len(rows), over

    # Records -------------------------------------------------------------------------

    def _take(self, record: Record) -> None:
        value, name = record.value, record.stream
        account = self.found.streams.setdefault(name, StreamAccount(name, record.kind))
        if name not in self._stamps:
            self._stamps[name] = StampCheck(account, steady=self.found.kind == "rig")
        check, received = self._stamps[name], record.received_ns
        if received is not None and record.published_ns is not None and self.found.kind == "rig":
            self._walls.setdefault(name, WallClock()).add(received, record.published_ns)
        if isinstance(value, ImuSamples):
            for stamp in value.time_ns.tolist():
                check.add(stamp, received if len(value) == 1 else None)
        elif isinstance(value, LidarReturns):
            self._lidar(name, value, received)
            check.add(int(value.time_ns.min()) if len(value) else None, received)
        elif isinstance(value, PictureInfo):
            check.add(value.time_ns, received, value.number)
            self._info(name, value, received if received is not None else value.time_ns)
        elif isinstance(value, Picture):
            counted = value.number if self.found.kind != "video" else None
            check.add(value.time_ns, received, counted)
            self._look(name, value, received if received is not None else value.time_ns)

    def _camera(self, name: str) -> CameraAccount:
        return self.found.cameras.setdefault(name, CameraAccount(name))

    def _info(self, name: str, info: PictureInfo, time: int) -> None:
        if name not in self._cameras:
            lens = self._lens if not self._cameras else ()
            self._cameras[name] = CameraCheck(self._camera(name), lens)
        if self._camera(name).n in self._bare.get(name, ()):
            self._camera(name).without_picture.append(time)
        self._cameras[name].add(time, info)

    def _look(self, name: str, picture: Picture, time: int) -> None:
        """Look at a picture now and then."""
        owner = f"{name.rpartition('/')[0]}/info"
        name = owner if owner in self.found.cameras else name
        if name not in self._bright:
            self._bright[name] = Brightness(self._camera(name)), []
        bright, last = self._bright[name]
        if not last or abs(time - last[0]) >= _SPARSE_NS:
            bright.add(picture.pixels)
            last[:] = [time]

    def _lidar(self, name: str, value: LidarReturns, received: int | None) -> None:
        """How many returns, and how much of the time between them is in holes."""
        if self.found.kind == "lvx":
            account = self.found.streams[name]
            low, high = int(value.time_ns.min()), int(value.time_ns.max())
            account.first_ns = low if account.first_ns is None else min(low, account.first_ns)
            account.last_ns = high if account.last_ns is None else max(high, account.last_ns)
            return
        columns = self._returns.setdefault(name, (array("q"), array("q"), array("q")))
        steps = np.diff(np.sort(value.time_ns))
        hole = int(steps[steps > _HOLE_NS].sum())
        time = received if received is not None else int(value.time_ns.min()) if len(value) else 0
        for column, number in zip(columns, (time, len(value), hole), strict=True):
            column.append(number)

    # The end -------------------------------------------------------------------------

    def _close(self) -> None:
        found = self.found
        found.wall = wall_account(self._walls.values())
        for name, columns in self._returns.items():
            found.lidars[name] = _lidar_account(name, *(np.array(column) for column in columns))
        if isinstance(self.reader, LvxReader):
            _lvx(self.reader, found)
        if isinstance(self.reader, RigReader):
            self._pictures(self.reader)
        for bright, _ in self._bright.values():
            bright.finish()
        for name, account in found.streams.items():
            if account.kind in ("image", "video"):
                account.unit = "pictures"
            if account.kind == "imu":
                account.unit = "samples"
            account.expected_hz = account.expected_hz or self._expected.get(name)

    def _pictures(self, reader: RigReader) -> None:
        """Count the pictures of the videos, and look at some."""
        counts = {stream.name: stream.count or 0 for stream in reader.streams}
        for camera in reader.cameras:
            image, info = f"/{camera}/image", f"/{camera}/info"
            account, source = self._camera(info), self.found.streams.get(info)
            stream = self.found.streams.setdefault(image, StreamAccount(image, "image"))
            if self.tell is not None:
                self.tell(f"looking at pictures of {camera}")
            if image not in self._stamps:
                stream.count, stream.rate_hz = counts.get(image, 0), source.rate_hz if source else 0.0
                if source is not None and stream.count:
                    stream.first_ns, stream.last_ns = source.first_ns, source.last_ns
                stream.gaps = _runs(image, account.without_picture, stream.rate_hz)
                stream.lost = account.n_without
                which = np.unique(np.linspace(0, stream.count - 1, SAMPLED).astype(int))
                bright = Brightness(account)
                for picture in reader.pictures(image, which.tolist() if stream.count else []):
                    bright.add(picture.pixels)
                bright.finish()

    def _plain_video(self) -> None:
        """Stamps of all frames, and some frames decoded."""
        from acino_fte.data_tools.video import VideoReader
        from acino_fte.data_tools.video_cut import is_cut
        from acino_fte.errors import InputError

        reader = self.reader
        if not isinstance(reader, VideoReader):
            return
        name = reader.streams[0].name
        stamps, places = reader.stamps_ns, []
        account = self.found.streams[name]
        check = self._stamps[name] = StampCheck(account, steady=False)
        for stamp in stamps.tolist():
            check.add(stamp)
        bright, lost = Brightness(self._camera(name)), 0
        for n in np.unique(np.linspace(0, max(len(stamps) - 1, 0), SAMPLED).astype(int)).tolist():
            try:
                bright.add(reader.at(n).pixels)
            except InputError:
                lost += 1
                places.append(f"frame {n} does not decode")
        bright.finish()
        if is_cut(reader.path):
            places.append(f"the file is cut after frame {len(stamps) - 1}")
        self.found.damage = Damage(len(stamps), lost, 0, tuple(places))


def _lidar_account(name: str, time: np.ndarray, returns: np.ndarray, holes: np.ndarray) -> LidarAccount:
    usual = float(np.median(returns)) if len(returns) else 0.0
    thin = time[returns < _THIN * usual]
    judged = len(holes) > 0 and float(np.median(holes)) == 0
    lost = int(np.rint(holes / _DATAGRAM_NS).sum()) if judged else 0
    where = time[holes > 0][:MOST].tolist() if judged else []
    return LidarAccount(name, usual, thin[:MOST].tolist(), len(thin), len(time), lost, where, judged)


def _runs(stream: str, times: list[int], rate: float) -> list[Gap]:
    """Missing pictures at these times, those next to each other as one gap."""
    period = 1e9 / rate if rate else 0.0
    gaps: list[Gap] = []
    for time in times:
        if gaps and time - gaps[-1].end_ns < 0.5 * period:
            gaps[-1].lost += 1
            gaps[-1].seconds = gaps[-1].lost * period * 1e-9
        else:
            gaps.append(Gap(stream, time, period * 1e-9, 1))
    return gaps


def _lvx(reader: LvxReader, found: Findings) -> None:
    """The account of packages, and what the lidars warned of."""
    from acino_fte.rig.check_types import ClockJump

    found.health_told = reader.version != "2"
    said: set[str] = set()
    n_lost = 0
    for name, log in reader.stamp_logs.items():
        account = found.streams.setdefault(name, StreamAccount(name, "lidar"))
        said.update(log.sentences())
        n_lost += log.n_lost
        if account.kind != "lidar":
            continue
        account.unit, account.count, account.lost = "packages", log.n, log.n_lost
        account.gaps = [Gap(name, start, length * 1e-9, n) for start, length, n in log.gaps]
        account.more_gaps = log.n_gaps - len(log.gaps)
        account.jumps = [
            ClockJump(name, at - round(size * 1e9), at, size)
            for at, size in zip(log.jumped_ns, log.jumps, strict=True)
        ]
        whole = (account.count + account.lost) / account.seconds if account.seconds else 0.0
        account.rate_hz, account.jitter_ms, account.worst_step_ms = whole, 0.0, 0.0
        account.duplicates = account.out_of_order = 0
    found.warned = [
        Warned(f"lidar{w.device}", w.text, w.level, w.count, w.first_ns, w.last_ns) for w in reader.warnings
    ]
    damage = reader.damage
    places = tuple(place for place in damage.places if place not in said)
    found.damage = Damage(damage.n_read, max(damage.n_lost - n_lost, 0), damage.bytes_lost, places)
