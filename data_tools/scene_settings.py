"""What a recording's ``scene.yaml`` says about it, so that a command needs less.

Everything is optional:

.. code-block:: yaml

    pattern: "{camera}_{frame}.jpg"   # how image names give camera and frame
    fps: 30
    scale: [left-right=0.6, "tracks:0-1=0.5"]
    rig: auto                         # or none, or [[left, right], [front, back]]
    gravity: cameras                  # or plane, down, none, a file of accelerations
    tracks: tracks
    model: sparse/0
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from acino_fte.errors import InputError

NAME = "scene.yaml"
RigChoice = str | tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class SceneSettings:
    """The settings of a recording; None where the file does not say.

    Attributes
    ----------
    pattern : str, optional
        How image names give camera and frame.
    fps : float, optional
        Frames per second.
    scale : tuple of str, optional
        Known distances.
    rig : str or tuple of tuples of str, optional
        ``auto``, ``none``, or the cameras of each rig.
    gravity : str, optional
        What is up; a file is beside the settings, or absolute.
    tracks : str, optional
        Folder of the 2D tracks.
    model : Path, optional
        Folder of the COLMAP model.
    pixel_origin : str, optional
        ``centre`` or ``corner`` of the first pixel, which the tracks count from.
    noise_px : float, optional
        Standard deviation of a dot's coordinate.
    time_offsets : bool, optional
        Whether the cameras' clocks differ.
    """

    pattern: str | None = None
    fps: float | None = None
    scale: tuple[str, ...] | None = None
    rig: RigChoice | None = None
    gravity: str | None = None
    tracks: str | None = None
    model: Path | None = None
    pixel_origin: str | None = None
    noise_px: float | None = None
    time_offsets: bool | None = None


def read_scene_settings(folder: Path) -> SceneSettings:
    """The settings in a folder; empty without a file.

    Parameters
    ----------
    folder : Path
        Of the recording.

    Raises
    ------
    InputError
        The file cannot be read, has a key that means nothing, or a value of another kind.
    """
    path = folder / NAME
    if not path.is_file():
        return SceneSettings()
    import yaml

    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeError, yaml.YAMLError) as error:
        raise InputError("The scene file cannot be read.", file=path, found=str(error)) from None
    content = {} if content is None else content
    known = [f.name for f in fields(SceneSettings)]
    if not isinstance(content, dict):
        raise InputError("The scene file is no table.", file=path, expected=f"keys: {', '.join(known)}")
    unknown = [str(key) for key in content if key not in known]
    if unknown:
        raise InputError(
            "The scene file has keys that mean nothing.",
            file=path,
            expected=f"some of {', '.join(known)}",
            found=", ".join(unknown),
        )
    given = {key: value for key, value in content.items() if value is not None}
    return SceneSettings(**{key: _value(key, value, path) for key, value in given.items()})


def _value(key: str, value: Any, path: Path) -> Any:
    """A value as :class:`SceneSettings` has it."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if key in ("fps", "noise_px") and number and 0 < value < float("inf"):
        return float(value)
    if key == "time_offsets" and isinstance(value, bool):
        return value
    if key == "pixel_origin" and value in ("centre", "corner"):
        return value
    if key == "scale":
        texts = [value] if isinstance(value, str) else value
        if isinstance(texts, list) and all(isinstance(text, str) for text in texts):
            return tuple(texts)
    if key == "rig" and isinstance(value, list):
        rigs = [value] if all(not isinstance(part, list) for part in value) else value
        if all(isinstance(part, list) and len(part) > 1 for part in rigs):
            return tuple(tuple(str(name) for name in part) for part in rigs)
    if key == "rig" and (value is False or value in ("auto", "none")):  # YAML reads off and no as false
        return value or "none"
    if key in ("model", "gravity") and isinstance(value, str):
        beside = path.parent / value
        if key == "model":
            return beside
        return str(beside) if beside.is_file() else value
    if key in ("pattern", "tracks") and isinstance(value, str):
        return value
    raise InputError(
        "The scene file has a value of the wrong kind.",
        file=path,
        key=key,
        expected=_EXPECTED[key],
        found=repr(value),
    )


_EXPECTED = {
    "pattern": "a text such as '{camera}_{frame}.jpg'",
    "fps": "a number above 0",
    "scale": "a list of distances such as left-right=0.6",
    "rig": "auto, none, or a list of cameras, two or more for each rig",
    "gravity": "cameras, plane, down, none, or a file",
    "tracks": "the name of a folder",
    "model": "the name of a folder",
    "pixel_origin": "centre or corner",
    "noise_px": "a number above 0",
    "time_offsets": "true or false",
}
