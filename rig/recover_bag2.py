"""Rescue of a folder of rosbag2: its files one by one, and a metadata.yaml made from what they hold."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from acino_fte.data_tools.bags_folder import files_of
from acino_fte.errors import InputError
from acino_fte.rig.recover_files import Settings, copy_sound, file_kind, is_sound, rescue_file, salvage_file
from acino_fte.rig.recover_types import Salvaged, merged

METADATA = "metadata.yaml"
_VERSION = 8


def salvage_bag2(source: Path, target: Path | None, settings: Settings) -> Salvaged:
    """Rescue every file of a ROS 2 bag into a new folder.

    Parameters
    ----------
    source : Path
        A folder of .db3 or .mcap files, with or without metadata.yaml.
    target : Path, optional
        The new folder, which is there; without it only count.
    settings : Settings
        What the user said.
    """
    files, said, notes = files_of(source)
    parts: list[tuple[str, Salvaged]] = []
    whole = not notes
    for path in files:
        name = path.name.removesuffix(".zstd")
        try:
            part = _part(path, target / name if target is not None else None, settings)
        except InputError as error:
            notes.append(f"{path.name}: nothing can be saved ({error.problem})")
            whole = False
            continue
        parts.append((name, part))
        whole = whole and part.whole
        notes += [f"{name}: {note}" if len(files) > 1 else note for note in part.notes]
    streams = merged(stream for _, part in parts for stream in part.streams)
    saved = sum(stream.saved for stream in streams)
    known = sum(stream.lost for stream in streams)
    elsewhere = sum(part.lost_elsewhere for _, part in parts)
    if said is not None:
        elsewhere = max(elsewhere, said - saved - known)
        whole = whole and said <= saved
    if target is not None and parts:
        _write_metadata(target, parts, streams)
    return Salvaged(
        "ROS 2 bag",
        whole and bool(parts),
        streams,
        elsewhere,
        sum(part.bytes_lost for _, part in parts),
        tuple(notes),
    )


def _part(path: Path, target: Path | None, settings: Settings) -> Salvaged:
    sound = is_sound(path, settings)
    if sound is not None:
        if target is not None:
            copy_sound(path, target, settings)
        return sound
    if target is None:
        return salvage_file(path, None, settings)
    found = rescue_file(path, target, settings)
    if not found.saved:
        target.unlink(missing_ok=True)
        raise InputError("it holds no whole message", file=path)
    return found


def _write_metadata(target: Path, parts: list[tuple[str, Salvaged]], streams: Any) -> None:
    """The metadata of rosbag2: topics, counts and times, of all files and of each."""
    import yaml

    topics: dict[str, dict[str, str]] = {}
    for _, part in parts:
        for name, about in part.topics.items():
            topics.setdefault(name, about)
    packed = any("compressed" in about for about in topics.values())
    kinds = [file_kind(target / name) for name, _ in parts]
    content = {
        "version": _VERSION,
        "storage_identifier": "mcap" if kinds[0] == "mcap" else "sqlite3",
        **_times(streams),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": stream.name,
                    "type": topics.get(stream.name, {}).get("type", stream.type),
                    "serialization_format": topics.get(stream.name, {}).get("serialization_format", "cdr"),
                    "offered_qos_profiles": topics.get(stream.name, {}).get("offered_qos_profiles", ""),
                    "type_description_hash": topics.get(stream.name, {}).get("type_description_hash", ""),
                },
                "message_count": stream.saved,
            }
            for stream in streams
        ],
        "compression_format": "zstd" if packed else "",
        "compression_mode": "message" if packed else "",
        "relative_file_paths": [name for name, _ in parts],
        "files": [{"path": name, **_times(part.streams)} for name, part in parts],
        "custom_data": None,
        "ros_distro": "unknown",
    }
    text = yaml.safe_dump({"rosbag2_bagfile_information": content}, sort_keys=False)
    (target / METADATA).write_text(text, encoding="utf-8")


def _times(streams: Any) -> dict[str, Any]:
    first = min((s.first_ns for s in streams if s.first_ns is not None), default=0)
    last = max((s.last_ns for s in streams if s.last_ns is not None), default=first)
    return {
        "duration": {"nanoseconds": last - first},
        "starting_time": {"nanoseconds_since_epoch": first},
        "message_count": sum(s.saved for s in streams),
    }
