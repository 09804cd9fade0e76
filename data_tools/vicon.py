"""Cameras of a Vicon calibration file, ``.xcp``.

Each ``Camera`` holds its SENSOR_SIZE and, in its ``KeyFrame``, POSITION (centre in the world, mm),
ORIENTATION (quaternion x y z w, world to camera), FOCAL_LENGTH (px), PRINCIPAL_POINT (px from the top left,
v down) and the lens, VICON_RADIAL2 (older files: VICON_RADIAL, about the principal point). The vertical focal
length is FOCAL_LENGTH / PIXEL_ASPECT_RATIO, as other readers of these files have it; we know no file where
the ratio is not 1. Where Vicon puts the centre of the first pixel is not documented; here it is (0, 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from acino_fte.cameras import CameraArray
from acino_fte.data_tools.calibration import _with_file
from acino_fte.data_tools.projective_camera import ProjectiveCamera, ViconRadial
from acino_fte.errors import InputError, did_you_mean

_REMEDY = "export the calibration from Vicon again"
_MODEL = "Vicon3Parameter"
_MM = 1e-3


def read_xcp(path: Path | str, only: Sequence[str | int] | None = None) -> CameraArray:
    """Read the calibrated cameras of a Vicon file.

    Parameters
    ----------
    path : Path
        An ``.xcp`` file. One that declares a document type is refused, so no entity is ever expanded.
    only : sequence of str or int, optional
        DEVICEID or USERID of the cameras that are wanted, in the wanted order. Without it all cameras that
        are calibrated, in the order of the file.

    Returns
    -------
    CameraArray
        Of :class:`ProjectiveCamera`, named by their DEVICEID, m, for measured pixels: the lens is corrected.
        The latest key frame counts.

    Raises
    ------
    InputError
        The file is missing or of another kind, a camera is unknown or not calibrated, or an attribute is
        missing or no number.
    """
    path = Path(path)
    elements = [e for e in _root(path).iter("Camera")]
    for i, element in enumerate(elements):
        if not element.get("DEVICEID"):
            raise _fault(path, f"Camera {i + 1}", "DEVICEID", "the number of the device", None)
    if only is None:
        chosen = [e for e in elements if _key_frame(e, path) is not None]
    else:
        chosen = [_named(elements, str(wanted), path) for wanted in only]
    if not chosen:
        raise InputError(
            "The Vicon file has no calibrated camera.",
            file=path,
            expected="Camera elements with a KeyFrame that has POSITION and ORIENTATION",
            found=f"{len(elements)} cameras, none of them calibrated" if elements else "no Camera element",
            remedy="calibrate the cameras and save the file again",
        )
    cameras = tuple(_camera(element, path) for element in chosen)
    try:
        return CameraArray(cameras)
    except InputError as error:
        raise _with_file(error, path, "DEVICEID") from None


def _root(path: Path) -> ElementTree.Element:
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise InputError("The camera file does not exist.", file=path, remedy="check the path") from None
    except UnicodeDecodeError:
        raise InputError(
            "The Vicon file is no UTF-8 text.", file=path, expected="XML", found="other bytes", remedy=_REMEDY
        ) from None
    except OSError as error:
        raise InputError("The camera file cannot be opened.", file=path, found=str(error)) from None
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(
            "The Vicon file declares a document type, which is refused for safety.",
            file=path,
            expected="XML without <!DOCTYPE>, as Vicon writes it",
            found="<!DOCTYPE> or <!ENTITY>",
            remedy="remove the declaration, or export the calibration from Vicon again",
        )
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(
            "The Vicon file is no XML.", file=path, expected="XML", found=str(error), remedy=_REMEDY
        ) from None


def _named(elements: list[ElementTree.Element], wanted: str, path: Path) -> ElementTree.Element:
    """The camera of a DEVICEID, or else of a USERID."""
    for key in ("DEVICEID", "USERID"):
        found = [e for e in elements if e.get(key) == wanted]
        if len(found) == 1:
            return found[0]
    devices = [e.get("DEVICEID", "") for e in elements]
    listed = ", ".join(devices[:8]) + (", …" if len(devices) > 8 else "")
    raise InputError(
        f"The Vicon file has no camera '{wanted}'{did_you_mean(wanted, devices) or '.'}",
        file=path,
        key="only",
        expected=f"a DEVICEID ({listed}) or a unique USERID",
        found=wanted,
        remedy="choose cameras of the file",
    )


def _key_frame(element: ElementTree.Element, path: Path) -> ElementTree.Element | None:
    """The latest key frame with a pose."""
    frames = [f for f in element.iter("KeyFrame") if f.get("POSITION") and f.get("ORIENTATION")]
    place = f"Camera {element.get('DEVICEID')}, KeyFrame"
    order = [_numbers(f, "FRAME", 1, path, place)[0] if f.get("FRAME") else 0.0 for f in frames]
    return frames[max(range(len(frames)), key=lambda i: (order[i], i))] if frames else None


def _camera(element: ElementTree.Element, path: Path) -> ProjectiveCamera:
    name = element.get("DEVICEID", "")
    place = f"Camera {name}"
    frame = _key_frame(element, path)
    if frame is None:
        raise InputError(
            f"Camera '{name}' is not calibrated.",
            file=path,
            key=place,
            expected="a KeyFrame with POSITION and ORIENTATION",
            found="none",
            remedy="calibrate it, or leave it out",
        )
    width, height = _numbers(element, "SENSOR_SIZE", 2, path, place)
    aspect = (
        _numbers(element, "PIXEL_ASPECT_RATIO", 1, path, place)[0]
        if element.get("PIXEL_ASPECT_RATIO")
        else 1.0
    )
    within = f"{place}, KeyFrame"
    focal = _numbers(frame, "FOCAL_LENGTH", 1, path, within)[0]
    point = _numbers(frame, "PRINCIPAL_POINT", 2, path, within)
    quaternion = _numbers(frame, "ORIENTATION", 4, path, within)
    position = _numbers(frame, "POSITION", 3, path, within) * _MM
    if not (focal > 0 and aspect > 0 and min(width, height) >= 1):
        found = f"FOCAL_LENGTH {focal:g}, PIXEL_ASPECT_RATIO {aspect:g}, SENSOR_SIZE {width:g} {height:g}"
        raise _fault(path, place, "FOCAL_LENGTH, PIXEL_ASPECT_RATIO, SENSOR_SIZE", "positive numbers", found)
    if abs(np.linalg.norm(quaternion) - 1) > 1e-3:
        found = f"length {np.linalg.norm(quaternion):.3g}"
        raise _fault(path, within, "ORIENTATION", "a unit quaternion x y z w", found)
    for holder in (element, frame):
        if holder.get("SKEW") and _numbers(holder, "SKEW", 1, path, place)[0] != 0:
            raise _fault(path, place, "SKEW", "0", holder.get("SKEW"))
    rotation = Rotation.from_quat(quaternion).as_matrix()
    matrix = np.array([[focal, 0, point[0]], [0, focal / aspect, point[1]], [0, 0, 1]])
    radial = _radial(frame, point, path, within)
    size = (int(width), int(height))
    return ProjectiveCamera(name, matrix, rotation, -rotation @ position, size, radial)


def _radial(frame: ElementTree.Element, point: np.ndarray, path: Path, place: str) -> ViconRadial | None:
    """The lens of a key frame; None when it does nothing."""
    text = frame.get("VICON_RADIAL2")
    if text:
        model, _, rest = text.partition(" ")
        if model != _MODEL:
            raise _fault(path, place, "VICON_RADIAL2", f"the model {_MODEL} and 5 numbers", text)
        values = _parsed(rest, 5, path, place, "VICON_RADIAL2")
        centre, coefficients = values[:2], values[2:]
    elif frame.get("VICON_RADIAL"):
        centre, coefficients = point, np.append(_numbers(frame, "VICON_RADIAL", 2, path, place), 0.0)
    else:
        return None
    return ViconRadial(centre, coefficients) if coefficients.any() else None


def _numbers(element: ElementTree.Element, key: str, count: int, path: Path, place: str) -> np.ndarray:
    text = element.get(key)
    if text is None:
        raise _fault(path, place, key, f"{count} number{'s' if count > 1 else ''}", None)
    return _parsed(text, count, path, place, key)


def _parsed(text: str, count: int, path: Path, place: str, key: str) -> np.ndarray:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise _fault(path, place, key, f"{count} finite number{'s' if count > 1 else ''}", text)
    return values


def _fault(path: Path, place: str, key: str, expected: str, found: str | None) -> InputError:
    return InputError(
        f"The Vicon file {'lacks an attribute' if found is None else 'has a wrong attribute'}.",
        file=path,
        key=f"{place}: {key}",
        expected=expected,
        found="nothing" if found is None else repr(found[:80]),
        remedy=_REMEDY,
    )
