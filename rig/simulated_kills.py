"""Kills a recorder at a random moment, as ``kill -9`` does, and looks at what is left.

A recorder in a process of its own tells, ten times a second, how much its writers have written; what it told
at least a second before it was killed must be readable: 99 % of it.
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acino_fte.data_tools.rig_recording import Manifest, read_manifest
from acino_fte.errors import InputError
from acino_fte.rig.rig_file import CameraPart, LidarPart, RigFile, Storage

SHARE, AGE_S = 0.99, 1.0
_PRELOAD = ["acino_fte.rig.session", "acino_fte.rig.recover", "av", "mcap.writer", "rosbags.typesys"]
_START_S = 60.0


@dataclass(frozen=True)
class Left:
    """What a kill left.

    Attributes
    ----------
    after_s : float
        How long it had recorded.
    expected : dict
        By stream: what was written a second before.
    direct, recovered : dict
        What the readers find in the folder itself, and in the copy of ``rig recover``.
    problems : tuple of str
    """

    after_s: float
    expected: dict[str, int]
    direct: dict[str, int]
    recovered: dict[str, int]
    problems: tuple[str, ...]

    @property
    def share(self) -> float:
        """The least share of any stream that the copy holds of what was expected; 1 where nothing was."""
        return min((self.recovered.get(k, 0) / n for k, n in self.expected.items() if n), default=1.0)


def kill_rig() -> RigFile:
    """A small rig whose segments are so short that kills meet their seams."""
    return RigFile(
        cameras={"cam1": CameraPart(width=320, height=240)},
        lidars={"lidar1": LidarPart(points=2000)},
        storage=Storage(segment_s=0.7, reserve_gb=0.1),
    )


def kill_recorders(folder: Path, delays_s: Sequence[float]) -> Iterator[Left]:
    """Record, kill and judge, several recorders at once, one for each delay.

    Parameters
    ----------
    folder : Path
        For the recordings; those that are sound are removed again.
    delays_s : sequence of float
        How long after its beginning each recorder is killed.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOAD)
    rig, begun = kill_rig(), []
    for i in range(len(delays_s)):
        receiver, sender = context.Pipe(False)
        target = folder / f"run-{i}" / "recording"
        process = context.Process(target=_record, args=(target, rig.model_dump_json(), sender), daemon=True)
        process.start()
        sender.close()
        begun.append((process, receiver, target))
    for (process, receiver, target), delay in sorted(zip(begun, delays_s, strict=True), key=lambda p: p[1]):
        if not receiver.poll(_START_S):
            raise TimeoutError("the recorder does not begin")
        reports = [receiver.recv()]
        time.sleep(max(delay - (time.monotonic_ns() - reports[0][0]) * 1e-9, 0.0))
        os.kill(process.pid or 0, signal.SIGKILL)
        killed = time.monotonic_ns()
        process.join()
        reports += _rest(receiver)
        yield _judge(target, reports, killed, rig)
        shutil.rmtree(target.parent)


def _record(folder: Path, rig: str, pipe: Any) -> None:
    """In the process that will be killed."""
    from acino_fte.rig.session import Session, SessionOptions

    session = Session(RigFile.model_validate_json(rig), folder, SessionOptions(simulate=True, probe=False))
    session.preflight()
    session.record(600.0, lambda status: pipe.send((time.monotonic_ns(), status.written)))


def _rest(receiver: Any) -> list[tuple[int, dict[str, int]]]:
    found = []
    try:
        while receiver.poll(0):
            found.append(receiver.recv())
    except (EOFError, OSError):
        pass
    return found


def _judge(folder: Path, reports: list[tuple[int, dict[str, int]]], killed: int, rig: RigFile) -> Left:
    old = [written for at, written in reports if at <= killed - AGE_S * 1e9]
    expected = old[-1] if old else {}
    direct: dict[str, int] = {}
    recovered: dict[str, int] = {}
    problems = list(_look(folder, direct))
    manifest = read_manifest(folder)
    problems += _inconsistent(folder, manifest)
    copy = folder.with_name("copy")
    try:
        from acino_fte.rig.recover import recover

        recover(folder, copy)
        problems += [f"copy: {problem}" for problem in _look(copy, recovered, whole=True)]
        problems += [f"copy: {problem}" for problem in _inconsistent(copy, read_manifest(copy))]
    except InputError as error:
        if any(expected.values()):
            problems.append(str(error))
    for name, n in expected.items():
        for what, found in (("the folder", direct), ("the copy", recovered)):
            if found.get(name, 0) < SHARE * n:
                problems.append(f"{name}: {what} has {found.get(name, 0)} of {n}")
    started = manifest.started_monotonic_ns
    return Left((killed - started) * 1e-9, expected, direct, recovered, tuple(problems))


def _look(folder: Path, counts: dict[str, int], whole: bool = False) -> Iterator[str]:
    """Count what can be read; what cannot must be empty, being just begun."""
    from acino_fte.data_tools.bags import BagReader
    from acino_fte.data_tools.video import VideoReader

    for path in sorted(folder.glob("messages-*.mcap")):
        try:
            with BagReader(path) as reader:
                for record in reader.records():
                    counts[record.stream] = counts.get(record.stream, 0) + 1
                if whole and not reader.damage.whole:
                    yield f"{path.name}: {reader.damage}"
        except InputError as error:
            if path.stat().st_size > 64 or whole:
                yield str(error)
    for path in sorted(folder.glob("*.mkv")):
        try:
            with VideoReader(path) as video:
                camera = path.stem.rpartition("-")[0]
                counts[camera] = counts.get(camera, 0) + sum(1 for _ in video.records())
        except InputError as error:
            if path.stat().st_size > 1024 or whole:
                yield str(error)


def _inconsistent(folder: Path, manifest: Manifest) -> Iterator[str]:
    """Where a manifest is at odds with the files beside it."""
    from acino_fte.data_tools.bags import BagReader
    from acino_fte.data_tools.video import VideoReader

    named = {segment.file: segment for segment in manifest.segments}
    for path in [*folder.glob("*.mcap"), *folder.glob("*.mkv")]:
        if path.name not in named:
            yield f"{path.name} is not in the manifest"
    for segment in manifest.segments:
        path = folder / segment.file
        if not path.exists():
            yield f"{segment.file} is in the manifest, but not there"
        elif segment.closed and segment.kind == "messages":
            with BagReader(path) as reader:
                found = {stream.name: stream.count for stream in reader.streams}
            if found != segment.counts or path.stat().st_size != segment.n_bytes:
                yield f"{segment.file}: the manifest says {segment.counts}, it holds {found}"
        elif segment.closed:
            with VideoReader(path) as video:
                if [len(video)] != list(segment.counts.values()):
                    yield f"{segment.file}: the manifest says {segment.counts}, it holds {len(video)}"
