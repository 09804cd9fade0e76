"""Folders of rosbag2: which files they have, with or without their metadata.yaml."""

from __future__ import annotations

from pathlib import Path

from acino_fte.data_tools.pictures import natural_order
from acino_fte.errors import InputError

_SUFFIXES = (".db3", ".mcap", ".db3.zstd", ".mcap.zstd")


def files_of(folder: Path) -> tuple[list[Path], int | None, list[str]]:
    """Files of a bag in order, how many messages the metadata tell of, and notes.

    Raises
    ------
    InputError
        The folder has no files of a bag.
    """
    said, names, notes = _metadata(folder)
    there = sorted(
        (f for f in folder.iterdir() if f.is_file() and f.name.endswith(_SUFFIXES)),
        key=lambda f: natural_order(f.name),
    )
    files = []
    for name in names:
        file = folder / Path(name).name
        if file.is_file():
            files.append(file)
        elif (packed := file.with_name(file.name + ".zstd")).is_file():
            files.append(packed)
        else:
            notes.append(f"metadata.yaml names {name}, which is not there")
    extra = [f for f in there if f not in files]
    if extra and names:
        notes.append(f"metadata.yaml does not name {', '.join(f.name for f in extra)}; they are read too")
        said = None
    files += extra
    if not files:
        bags = [f.name for f in sorted(folder.glob("*.bag"))]
        raise InputError(
            "The folder is no bag of ROS 2.",
            file=folder,
            expected="metadata.yaml and .db3 or .mcap files",
            found=", ".join(sorted(f.name for f in folder.iterdir())[:5]) or "an empty folder",
            remedy=f"name the bag itself: {bags[0]}" if bags else None,
        )
    return files, said, notes


def _metadata(folder: Path) -> tuple[int | None, list[str], list[str]]:
    """(messages, names of files, notes) of metadata.yaml."""
    import yaml

    file = folder / "metadata.yaml"
    if not file.is_file():
        return None, [], ["metadata.yaml is missing: the files are taken in the order of their names"]
    try:
        content = yaml.safe_load(file.read_text("utf-8", "replace"))["rosbag2_bagfile_information"]
        count = content.get("message_count")
        names = [str(name) for name in content.get("relative_file_paths") or []]
        return (int(count) if isinstance(count, int) else None), names, []
    except (yaml.YAMLError, OSError, KeyError, TypeError, AttributeError) as error:
        return None, [], [f"metadata.yaml cannot be read ({type(error).__name__}): it is left aside"]
