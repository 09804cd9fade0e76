"""From the names of images to cameras and frames, and the cameras of a model with their key frames."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np

from acino_fte.data_tools.camera_keys import KeyedCamera
from acino_fte.data_tools.colmap import ColmapModel
from acino_fte.data_tools.track_table import natural_order
from acino_fte.errors import InputError

HOW_TO_NAME = (
    'give a pattern for the whole name, such as "{camera}_{frame}.jpg", "{camera}/frame{frame}.png" or '
    '"*/{camera}/*_{frame}.*" (* is anything but /), or "re:" and a regular expression with the groups '
    "camera and frame"
)
_STEM = re.compile(r"(?P<prefix>.*?)[_\-. ]?(?P<frame>[0-9]{1,18})")
_GENERIC = {"", "frame", "frames", "image", "images", "img", "im", "f"}
_ONE_CAMERA = "camera"
_TOKENS = re.compile(r"(\{[^{}]*\}|\*\*|\*|\?)")
_LENS_TOLERANCE = 1e-6
_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class ImageFrames:
    """The camera and the frame of each image. I images.

    Attributes
    ----------
    camera : tuple of str (I,)
        Name of the camera.
    frame : (I,) int
        Number of the frame, on the camera's own clock.
    rule : str
        How the names were read, for messages.
    """

    camera: tuple[str, ...]
    frame: np.ndarray
    rule: str = ""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Each camera once, in natural order: cam2 before cam10."""
        return tuple(sorted(set(self.camera), key=natural_order))


def parse_image_names(names: Sequence[str], pattern: str | None = None) -> ImageFrames:
    """Read camera and frame from the names of images.

    Parameters
    ----------
    names : sequence of str
        As the model has them, with folders.
    pattern : str, optional
        With placeholders, ``"{camera}_{frame}.jpg"`` (``*`` is anything but ``/``, ``**`` anything, ``?`` one
        character; without ``/`` it is for the name without folders), or ``"re:"`` and a regular expression
        for the whole name with the groups ``camera`` and ``frame``. Without a camera in it, there is one
        camera. By default a folder for each camera with the frame at the end of the name
        (``camera/000123.png``), or a prefix for each camera (``PREFIX_000123.jpg``).

    Returns
    -------
    ImageFrames

    Raises
    ------
    InputError
        Names do not fit, the pattern is wrong, or one frame of a camera has two images.
    """
    names = list(names)
    if pattern is not None:
        found = [
            _match(name, _compile(pattern), "/" in pattern or pattern.startswith("re:")) for name in names
        ]
        return _checked(names, _all_fit(names, found, pattern), pattern)
    split = [_split(name) for name in names]
    parts = _all_fit(names, split, None)
    attempts = [(rule, read(parts)) for rule, read in _RULES]
    fitting = [(rule, cameras) for rule, cameras in attempts if cameras is not None]
    for rule, cameras in fitting:
        pairs = [(camera, part.frame) for camera, part in zip(cameras, parts, strict=True)]
        if len(set(pairs)) == len(pairs):
            return _checked(names, pairs, rule)
    rule, cameras = fitting[0]
    return _checked(names, [(c, part.frame) for c, part in zip(cameras, parts, strict=True)], rule)


@dataclass(frozen=True)
class _Parts:
    """A name taken apart: folders, what is before the number, the number."""

    folders: tuple[str, ...]
    prefix: str
    frame: int


def _split(name: str) -> _Parts | None:
    *folders, base = name.replace("\\", "/").split("/")
    stem = base.rpartition(".")[0] or base
    match = _STEM.fullmatch(stem)
    if match is None:
        return None
    return _Parts(tuple(f for f in folders if f not in ("", ".")), match["prefix"], int(match["frame"]))


def _by_folder(parts: Sequence[_Parts]) -> list[str] | None:
    """A folder for each camera: the folders that differ, if each has images of one prefix only."""
    depth = {len(part.folders) for part in parts}
    if len(depth) != 1:
        return None
    varying = [i for i in range(depth.pop()) if len({part.folders[i] for part in parts}) > 1]
    if not varying:
        return None
    cameras = ["/".join(part.folders[i] for i in varying) for part in parts]
    pairs = {(camera, part.prefix) for camera, part in zip(cameras, parts, strict=True)}
    return cameras if len(pairs) == len(set(cameras)) else None


def _by_prefix(parts: Sequence[_Parts]) -> list[str]:
    """A prefix for each camera; of names that are a number the folder counts."""
    generic = all(part.prefix.lower() in _GENERIC for part in parts)
    if not generic:
        return [part.prefix or _ONE_CAMERA for part in parts]
    return [(part.folders[-1] if part.folders else part.prefix) or _ONE_CAMERA for part in parts]


def _by_both(parts: Sequence[_Parts]) -> list[str]:
    return ["/".join([*part.folders, part.prefix]).strip("/") or _ONE_CAMERA for part in parts]


_RULES: tuple[tuple[str, Callable[[Sequence[_Parts]], list[str] | None]], ...] = (
    ("{camera}/…{frame}", _by_folder),
    ("{camera}_{frame}", _by_prefix),
    ("{folders and prefix}_{frame}", _by_both),
)


def _compile(pattern: str) -> re.Pattern[str]:
    """A pattern as a regular expression for the whole name."""
    try:
        text = pattern[3:] if pattern.startswith("re:") else "".join(_translate(pattern))
        compiled = re.compile(text)
    except re.error as error:
        raise _bad_pattern(pattern, str(error)) from error
    if "frame" not in compiled.groupindex:
        raise _bad_pattern(pattern, "no {frame}")
    return compiled


def _translate(pattern: str) -> Iterator[str]:
    """The parts of a regular expression for a pattern with placeholders."""
    tokens = [token for token in _TOKENS.split(pattern) if token]
    open_ended = [token in ("{camera}", "*", "**") for token in tokens]
    seen: set[str] = set()
    simple = {"**": ".*", "*": "[^/]*", "?": "[^/]"}
    for i, token in enumerate(tokens):
        if token in simple:
            yield simple[token]
        elif token == "{camera}":
            yield "(?P=camera)" if token in seen else "(?P<camera>[^/]+)"
        elif token == "{frame}":
            before = "(?<![0-9])" if i and open_ended[i - 1] else ""
            after = "(?![0-9])" if i + 1 < len(tokens) and open_ended[i + 1] else ""
            yield before + ("(?P=frame)" if token in seen else "(?P<frame>[0-9]{1,18})") + after
        elif token.startswith("{"):
            raise _bad_pattern(pattern, f"the unknown placeholder {token}")
        else:
            yield re.escape(token)
        seen.add(token)


def _bad_pattern(pattern: str, found: str) -> InputError:
    return InputError(
        f"The pattern '{pattern}' for the names of images is wrong.",
        expected="{frame} (and {camera}) in it",
        found=found,
        remedy=HOW_TO_NAME,
    )


def _match(name: str, pattern: re.Pattern[str], whole: bool) -> tuple[str, int] | None:
    match = pattern.fullmatch(name if whole else name.rpartition("/")[2])
    if match is None:
        return None
    groups = match.groupdict(_ONE_CAMERA)
    frame = groups["frame"]
    digits = frame.removeprefix("-")
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 18):
        return None
    return groups.get("camera", _ONE_CAMERA), int(frame)


def _all_fit(names: Sequence[str], found: Sequence[_T | None], pattern: str | None) -> list[_T]:
    """What was found, if it was found in all names."""
    wrong = [name for name, each in zip(names, found, strict=True) if each is None]
    if not wrong:
        return [each for each in found if each is not None]
    shown = ", ".join(f"'{name}'" for name in wrong[:3]) + (", …" if len(wrong) > 3 else "")
    raise InputError(
        f"Camera and frame cannot be read from the names of {len(wrong)} of {len(names)} images.",
        key=None if pattern is None else f"pattern '{pattern}'",
        expected=f"names like {pattern}" if pattern else "names like PREFIX_000123.jpg or camera/000123.png",
        found=shown,
        remedy=HOW_TO_NAME,
    )


def _checked(names: Sequence[str], pairs: Sequence[tuple[str, int]], rule: str) -> ImageFrames:
    """The answer, if no frame of a camera has two images."""
    first: dict[tuple[str, int], str] = {}
    for name, pair in zip(names, pairs, strict=True):
        other = first.setdefault(pair, name)
        if other is not name:
            raise InputError(
                f"Two images are frame {pair[1]} of camera '{pair[0]}'.",
                key=f"pattern '{rule}'",
                expected="one image for each camera and frame",
                found=f"'{other}' and '{name}'",
                remedy=HOW_TO_NAME,
            )
    frame = np.array([frame for _, frame in pairs], dtype=np.int64)
    return ImageFrames(tuple(camera for camera, _ in pairs), frame, rule)


def keyed_cameras(
    model: ColmapModel, frames: ImageFrames, covariance: np.ndarray | None = None
) -> tuple[KeyedCamera, ...]:
    """The cameras of a model with their key frames, one for each name.

    Parameters
    ----------
    model : ColmapModel
        Its images are the rows of `frames`.
    frames : ImageFrames
        From :func:`parse_image_names` of the model's names.
    covariance : (I, 6, 6), optional
        Of the poses (see :class:`KeyedCamera`).

    Returns
    -------
    tuple of KeyedCamera
        In the natural order of names. Cameras of several names may share a camera of the model.

    Raises
    ------
    InputError
        One name has images of cameras with different lenses.
    """
    names = np.array(frames.camera)
    order = np.lexsort((frames.frame, names))
    starts = np.flatnonzero(np.concatenate([[True], names[order][1:] != names[order][:-1]]))
    rows_of = {str(names[rows[0]]): rows for rows in np.split(order, starts[1:])}
    return tuple(map(partial(_keyed_camera, model, frames, covariance, rows_of), frames.cameras))


def _keyed_camera(
    model: ColmapModel,
    frames: ImageFrames,
    covariance: np.ndarray | None,
    rows_of: dict[str, np.ndarray],
    name: str,
) -> KeyedCamera:
    rows = rows_of[name]
    model_id = _one_lens(model, name, rows)
    return KeyedCamera(
        name=name,
        lens=replace(model.cameras[model_id], name=name),
        model_id=model_id,
        frame=frames.frame[rows],
        rotation=model.rotation[rows],
        translation=model.translation[rows],
        covariance=None if covariance is None else covariance[rows],
    )


def _one_lens(model: ColmapModel, name: str, rows: np.ndarray) -> int:
    """The camera of the model that a name has; of several with the same lens the first."""
    ids = np.unique(model.camera_ids[rows]).tolist()
    first = model.cameras[ids[0]]
    for other_id in ids[1:]:
        other = model.cameras[other_id]
        same = other.model == first.model and other.resolution == first.resolution
        if same:
            largest = np.maximum(np.abs(first.parameters), 1.0)
            same = bool((np.abs(other.parameters - first.parameters) <= _LENS_TOLERANCE * largest).all())
        if not same:
            images = [model.names[rows[model.camera_ids[rows] == i][0]] for i in (ids[0], other_id)]
            raise InputError(
                f"Camera '{name}' has images with different lenses.",
                file=model.path,
                expected="one lens for each camera",
                found=f"camera {ids[0]} of '{images[0]}' and camera {other_id} of '{images[1]}'",
                remedy="reconstruct with one lens for each camera "
                "(`colmap feature_extractor --ImageReader.single_camera_per_folder 1`), or give "
                "a pattern that tells the cameras apart",
            )
    return ids[0]
