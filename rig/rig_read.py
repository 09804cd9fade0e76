"""Read, check and write a ``rig.yaml``."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from acino_fte.data_tools.whole_text import write_text_whole
from acino_fte.errors import InputError
from acino_fte.rig.rig_file import FILE_NAME, FORMAT, RigFile
from acino_fte.species_file import read_yaml, validation_message

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_SMALLEST, _LARGEST = 1e-9, 1e12
_HEADER = """\
# A rig: what it is made of, and what a recording with it is to reach.
# Whatever is left out has the value that a new file shows (acino-fte rig plan --init).
"""


def find_rig_file(path: Path | None = None) -> Path | None:
    """The file that a command means: a path, ``rig.yaml`` in a folder, or the one here; None for the default.

    Raises
    ------
    InputError
        The folder holds none.
    """
    if path is None:
        here = Path(FILE_NAME)
        return here if here.exists() else None
    if not path.is_dir():
        return path
    if not (path / FILE_NAME).exists():
        raise InputError(
            f"The folder holds no {FILE_NAME}.",
            file=path,
            remedy="name a file, or write one with: acino-fte rig plan --init",
        )
    return path / FILE_NAME


def read_rig(path: Path | str) -> RigFile:
    """Read and check a ``rig.yaml``.

    Parameters
    ----------
    path : Path
        The file, or a folder that holds a ``rig.yaml``.

    Returns
    -------
    RigFile

    Raises
    ------
    InputError
        The file is missing, is not YAML, does not follow the schema, or says what cannot be.
    """
    path = find_rig_file(Path(path)) or Path(path)
    data = read_yaml(path)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        kind = "nothing" if data is None else type(data).__name__
        raise InputError(
            "This is not a rig file of a format that this version reads.",
            file=path,
            key="format",
            expected=FORMAT,
            found=repr(data.get("format")) if isinstance(data, dict) else kind,
            remedy=f"write 'format: {FORMAT}' as its first line; acino-fte rig plan --init writes a new file",
        )
    return checked_rig(data, path)


def checked_rig(data: dict[str, Any], path: Path | None = None) -> RigFile:
    """A rig from plain data, checked against the schema and for what cannot be.

    Raises
    ------
    InputError
        The first fault, with the file where it is known.
    """
    try:
        rig = RigFile.model_validate(data)
    except ValidationError as error:
        place, text = validation_message(error, RigFile)
        raise InputError(
            f"The rig file has a fault at '{place}': {text}.",
            file=path,
            key=place,
            remedy="mend that key; acino-fte rig plan --init shows all of them",
        ) from None
    for key, problem, expected, found in _faults(rig):
        raise InputError(problem, file=path, key=key, expected=expected, found=found)
    return rig


def _faults(rig: RigFile) -> Iterator[tuple[str, str, str, str]]:
    """What the schema cannot say: key, problem, expected, found."""
    yield from _size_faults("", rig)
    yield from _name_faults(rig)
    for name, camera in rig.cameras.items():
        lens, key = camera.lens, f"cameras.{name}.lens"
        low, high = lens.focal_mm
        if not 0 < low <= high:
            text = "The range of focal lengths is impossible."
            yield f"{key}.focal_mm", text, "[shortest, longest], more than 0", f"[{low:g}, {high:g}]"
        elif not low <= lens.used_mm <= high:
            text = "The lens does not have this focal length."
            yield f"{key}.used_mm", text, f"from {low:g} to {high:g} mm", f"{lens.used_mm:g} mm"
        if lens.focus_m * 1e3 <= 2 * lens.used_mm:
            text = "A lens cannot focus that near."
            yield f"{key}.focus_m", text, "metres, more than twice the focal length", f"{lens.focus_m:g} m"
        if camera.frame_overhead_us + camera.line_us <= 0:
            yield f"cameras.{name}.line_us", "An image takes no time.", "more than 0", f"{camera.line_us:g}"
    for name, lidar in rig.lidars.items():
        if not all(0 < angle < 180 for angle in lidar.fov_deg):
            found = str(list(lidar.fov_deg))
            yield f"lidars.{name}.fov_deg", "The lidar has no such field.", "0 to 180 degrees", found


def _size_faults(place: str, value: Any) -> Iterator[tuple[str, str, str, str]]:
    """Numbers of which no rig can have one: a zero too many would end in an overflow, not in a plan."""
    if isinstance(value, BaseModel):
        value = dict(value)
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _size_faults(f"{place}.{key}".removeprefix("."), item)
    elif isinstance(value, tuple):
        for item in value:
            yield from _size_faults(place, item)
    elif isinstance(value, int | float) and value and not _SMALLEST <= abs(value) <= _LARGEST:
        yield place, "No rig has such a number.", f"{_SMALLEST:g} to {_LARGEST:g}", f"{value:g}"


def _name_faults(rig: RigFile) -> Iterator[tuple[str, str, str, str]]:
    """Names become those of files and topics."""
    parts = {"cameras": rig.cameras, "lidars": rig.lidars, "encoders": rig.encoders}
    for key, part in parts.items():
        for name in part:
            if not _NAME.fullmatch(name):
                expected = "a letter, then letters, digits and _"
                yield f"{key}.{name}", "This is no name for files and topics.", expected, repr(name)
    for name in rig.cameras.keys() & rig.lidars.keys():
        yield f"lidars.{name}", "A camera and a lidar have the same name.", "different names", repr(name)


def write_rig(path: Path | str, rig: RigFile | None = None) -> None:
    """Write a ``rig.yaml`` with comments, whole or not at all; the default rig unless one is given.

    Raises
    ------
    InputError
        It cannot be written.
    """
    write_text_whole(Path(path), rig_text(rig or RigFile()))


def rig_text(rig: RigFile) -> str:
    """A ``rig.yaml``, with what every key means beside it."""
    lines = list(_lines(rig, 0))
    column = max(len(line) for line, comment in lines if comment) + 2
    text = [f"{line:<{column}}# {comment}" if comment else line for line, comment in lines]
    return _HEADER + "\n".join(text) + "\n"


def _lines(part: BaseModel, depth: int) -> Iterator[tuple[str, str]]:
    """Lines of YAML with the comment of each."""
    indent = "  " * depth
    for key, field in type(part).model_fields.items():
        value, comment = getattr(part, key), field.description or ""
        if isinstance(value, BaseModel):
            yield f"{indent}{key}:", comment
            yield from _lines(value, depth + 1)
        elif isinstance(value, dict):
            yield f"{indent}{key}:" + ("" if value else " {}"), comment
            for name, item in value.items():
                yield f"{indent}  {_text(name)}:", ""
                yield from _lines(item, depth + 2)
        else:
            yield f"{indent}{key}: {_value(value)}", comment


def _value(value: Any) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, float):
        return repr(value).removesuffix(".0")
    return _text(value) if isinstance(value, str) else str(value)


def _text(value: str) -> str:
    """Text as YAML has it: in quotes where it would be something else without."""
    import yaml

    return yaml.safe_dump(value, allow_unicode=True, width=10**6).removesuffix("\n").removesuffix("\n...")
