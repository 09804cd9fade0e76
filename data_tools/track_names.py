"""Which file belongs to which camera, by name.

``cam0``, ``Camera 0``, ``cam_00``, ``K0`` and the bare number ``0`` are one name. A file may say more than
the name of its camera, in parts divided by anything but letters and digits: ``birds_cam1_tracks.csv`` is of
"cam1" and ``side.analysis.h5`` of "side". A bare number among other parts says nothing: it may count trials.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

_NUMBERED = re.compile(r"(?:cam|camera|view|k|c)?[ _-]*0*(\d+)", re.IGNORECASE)


def same_name(name: str) -> str:
    """The form in which two names of one camera are equal."""
    name = name.strip().casefold()
    match = _NUMBERED.fullmatch(name)
    return match[1] if match else name


def looks_like_camera(stem: str) -> bool:
    """Whether a file is called as if it were of a numbered camera: ``cam3``, ``camera_3``."""
    return re.fullmatch(r"cam(?:era)?[ _-]*\d+", stem, re.IGNORECASE) is not None


def cameras_of(stem: str, cameras: Sequence[str]) -> list[str]:
    """The cameras that a file with this name may belong to.

    Parameters
    ----------
    stem : str
        Name of a file without its endings, or of a folder.
    cameras : sequence of str
        Names of the cameras.

    Returns
    -------
    list of str
        One when it is clear, none when the name does not say, several when it is ambiguous.
    """
    whole = [camera for camera in cameras if same_name(camera) == same_name(stem)]
    if whole:
        return whole
    lower = stem.casefold()
    parts = {same_name(part) for part in re.split(r"[^a-z0-9]+", lower) if not part.isdigit()}
    return [
        camera
        for camera in cameras
        if same_name(camera) in parts
        or (
            not camera.isdigit()
            and re.search(rf"(?<![a-z0-9]){re.escape(camera.casefold())}(?![a-z0-9])", lower)
        )
    ]


def counted(names: Iterable[str], n_cameras: int) -> bool:
    """Whether the names are the numbers 0, 1, … of all cameras: then they count places, and name nothing."""
    return sorted(names) == sorted(str(i) for i in range(n_cameras))
