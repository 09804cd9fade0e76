"""What tells how a camera moved, from a table or from a recording: inertial samples, counts of encoders."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from acino_fte.data_tools.import_scan import damage_line
from acino_fte.data_tools.imu_table import read_imu_table
from acino_fte.data_tools.open_recording import open_recording
from acino_fte.data_tools.pan_tilt import read_encoder_table
from acino_fte.data_tools.recording import ImuSamples, Kind, PictureInfo, RecordingReader
from acino_fte.errors import InputError, did_you_mean

_HEAD = 4096  # bytes that tell a table from a recording
_SAME_PACE = 0.02  # of the frame rate, within which counted frames are those of the sequence
_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class EncoderCounts:
    """Counts of a pan-tilt head. K samples.

    Attributes
    ----------
    counts : (K, 2)
        Of pan and tilt.
    time : (K,), optional
        s, by any clock.
    frame : (K,) int, optional
        Frames of the sequence, where they are known.
    notes : tuple of str
        What the user should know.
    """

    counts: np.ndarray
    time: np.ndarray | None
    frame: np.ndarray | None
    notes: tuple[str, ...] = ()


def is_table(path: Path) -> bool:
    """Whether a file is text, or nothing that could be a recording."""
    try:
        if not path.is_file():
            return not path.exists()
        with path.open("rb") as file:
            return b"\0" not in file.read(_HEAD)
    except OSError as error:
        raise InputError(
            "The file cannot be read.", file=path, found=str(error), remedy="check that you may read it"
        ) from None


def inertial_samples(
    path: Path, topic: str | None, units: dict[str, str | None], sample_rate: float | None
) -> tuple[ImuSamples, tuple[str, ...]]:
    """Inertial samples of a table (CSV) or a recording, and what the user should know of them.

    Parameters
    ----------
    path : Path
        See :func:`acino_fte.data_tools.imu_table.read_imu_table` for tables, and
        :func:`acino_fte.data_tools.open_recording.open_recording` for recordings.
    topic : str, optional
        Stream of the recording; the only one by default.
    units, sample_rate
        Of a table.

    Raises
    ------
    InputError
        There is no such file or stream, or it cannot be read.
    """
    if is_table(path):
        return read_imu_table(path, sample_rate=sample_rate, **units), ()
    found: dict[str, list[ImuSamples]] = {}
    with _opened(path) as (reader, notes):
        for record in reader.records(kinds={"imu"}):
            if isinstance(record.value, ImuSamples) and len(record.value):
                found.setdefault(record.stream, []).append(record.value)
        parts = _chosen(found, path, topic, "imu", reader)
    samples = ImuSamples(
        np.concatenate([part.time_ns for part in parts]),
        np.concatenate([part.rate for part in parts]),
        np.concatenate([part.force for part in parts]),
        parts[0].clock,
    )
    return samples, tuple(notes)


def encoder_counts(
    path: Path, topic: str | None, places: tuple[int, int], fps: float, start: float
) -> EncoderCounts:
    """Counts of pan and tilt, of a table (CSV) or of the messages of a recording's camera.

    Parameters
    ----------
    path : Path
        See :func:`acino_fte.data_tools.pan_tilt.read_encoder_table` for tables.
    topic : str, optional
        Stream of the recording; the only one by default.
    places : (pan, tilt)
        Which numbers of a message they are, from 0.
    fps, start : float
        Of the sequence: frames per second, and the time of frame 0, s from the first message. The camera's
        own count of frames is used where it keeps that pace.

    Raises
    ------
    InputError
        There is no such file or stream, or it cannot be read, or its messages lack these numbers.
    """
    if is_table(path):
        return EncoderCounts(*read_encoder_table(path))
    found: dict[str, list[PictureInfo]] = {}
    with _opened(path) as (reader, notes):
        for record in reader.records(kinds={"image_info"}):
            if isinstance(record.value, PictureInfo):
                found.setdefault(record.stream, []).append(record.value)
        infos = _chosen(found, path, topic, "image_info", reader)
    whole = [info for info in infos if len(info.encoders) > max(places)]
    if min(places) < 0 or not whole:
        raise InputError(
            "The camera's messages have no such encoders.",
            file=path,
            key="--encoders",
            expected=f"numbers {places[0]} and {places[1]} (from 0) in each message",
            found=f"{len(infos[0].encoders)} numbers in the first",
        )
    if len(whole) < len(infos):
        notes.append(f"{len(infos) - len(whole)} of {len(infos)} messages lack the counts of the encoders.")
    counts = np.array([[info.encoders[place] for place in places] for info in whole], dtype=float)
    time = np.array([info.time_ns - whole[0].time_ns for info in whole]) * 1e-9
    number = np.array([info.number for info in whole])
    return EncoderCounts(counts, time, _counted(number, time, fps, start), tuple(notes))


def _counted(number: np.ndarray, time: np.ndarray, fps: float, start: float) -> np.ndarray | None:
    """Frames of the sequence by the camera's own count; None where it does not count at that pace."""
    step = np.diff(number)
    if not len(step) or (step <= 0).any() or not time[-1] > 0:
        return None
    if abs((number[-1] - number[0]) / time[-1] / fps - 1.0) > _SAME_PACE:
        return None
    return number - number[0] - round(start * fps)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[RecordingReader, list[str]]]:
    """A reader, and a list that gets what the reader has to say, without an error, at the end."""
    notes: list[str] = []
    with open_recording(path) as reader:
        yield reader, notes
        notes += getattr(reader, "notes", ())
        if not reader.damage.whole:
            notes.append(f"{path.name}: {damage_line(reader.damage)}")


def _chosen(
    found: dict[str, list[_T]], path: Path, topic: str | None, kind: Kind, reader: RecordingReader
) -> list[_T]:
    """The values of the named stream, or of the only one."""
    if topic is None and len(found) == 1:
        return next(iter(found.values()))
    if topic in found:
        return found[topic]
    what = {"imu": "an inertial sensor", "image_info": "a camera with encoders (XiImageInfo)"}[kind]
    if not found:
        kinds = ", ".join(f"{stream.name} ({stream.kind})" for stream in reader.streams)
        raise InputError(
            "The recording has nothing that tells how the camera moved.",
            file=path,
            expected=f"messages of {what}",
            found=kinds or "no stream at all",
        )
    raise InputError(
        f"The recording has no such stream{did_you_mean(topic, found)}"
        if topic
        else "The recording has several streams of this kind.",
        file=path,
        key="--topic",
        expected=f"one of {', '.join(found)}",
        found=topic or "none named",
    )
