"""The folders of AcinoSet: keypoints in ``dlc``, the scene's calibration in this or a folder above.

::

    2019_03_09/
        extrinsic_calib/6_cam_scene_sba.json
        lily/run1/
            cam1.mp4 … cam6.mp4
            dlc/cam1DLC_resnet50_….h5 … cam6DLC_resnet50_….h5

Cameras are paired by name: the file that starts with ``camN`` belongs to the N-th camera of the scene (or
to the camera that the scene calls ``camN``). Where a camera has both a CSV and an H5 file, the H5 file is
read: it is what DeepLabCut itself reads, and it has every digit.
"""

from __future__ import annotations

import re
from pathlib import Path

from acino_fte.data_tools.calibration import read_cameras
from acino_fte.data_tools.sequence_file import FILE_NAME, SequenceFile
from acino_fte.errors import InputError

KEYPOINTS = "dlc"
SCENES = "extrinsic_calib/*_cam_scene_sba.json"
_CAMERA = re.compile(r"cam(\d+)", re.IGNORECASE)
_REMEDY = f"write a {FILE_NAME} that names the camera file and the keypoint file of each camera wanted"


def is_acinoset(folder: Path) -> bool:
    """Whether a folder has the layout: a folder ``dlc`` with files that start with ``cam`` and a number."""
    return bool(_keypoint_files(folder))


def understand_acinoset(folder: Path) -> SequenceFile:
    """The ``sequence.yaml`` that an AcinoSet folder amounts to. Species and frame rate are not in it.

    Raises
    ------
    InputError
        There is no calibration, it has another number of cameras than there are keypoint files, the names
        do not match, or a camera has several files of one kind.
    """
    folder = folder.resolve()
    keypoints = {name: _choose(name, files) for name, files in _keypoint_files(folder).items()}
    scene = _scene(folder, len(keypoints))
    cameras = read_cameras(scene).names
    listed = ", ".join(path.name for path in keypoints.values())
    if len(cameras) != len(keypoints):
        raise InputError(
            f"The scene has {len(cameras)} cameras, but there are keypoint files of {len(keypoints)}.",
            file=scene,
            key="cameras",
            expected=f"one camera for each of {listed}",
            found=f"{len(cameras)} cameras: {', '.join(cameras)}",
            remedy=_REMEDY,
        )
    strangers = [name for name in keypoints if name not in cameras]
    if strangers:
        raise InputError(
            f"The scene has no camera '{strangers[0]}'.",
            file=scene,
            key="cameras",
            expected=f"a camera for each of {listed}",
            found=", ".join(cameras),
            remedy=_REMEDY,
        )
    return SequenceFile(
        name=folder.name,
        cameras=str(scene),
        keypoints={name: str(keypoints[name]) for name in cameras},
    )


def _keypoint_files(folder: Path) -> dict[str, list[Path]]:
    """CSV and H5 files in ``dlc`` by camera, in the order of the camera numbers."""
    found: dict[int, list[Path]] = {}
    for path in sorted((folder / KEYPOINTS).glob("*")):
        match = _CAMERA.match(path.name)
        if match and path.suffix.lower() in (".csv", ".h5"):
            found.setdefault(int(match[1]), []).append(path)
    return {f"cam{number}": found[number] for number in sorted(found)}


def _choose(name: str, files: list[Path]) -> Path:
    """The H5 file of a camera if there is one, else its CSV; two of one kind are refused."""
    wanted = [f for f in files if f.suffix.lower() == ".h5"] or files
    if len(wanted) > 1:
        raise InputError(
            f"Camera '{name}' has several keypoint files; which one is meant?",
            file=wanted[0].parent,
            key=name,
            expected="one CSV or one H5 file for each camera",
            found=", ".join(f.name for f in wanted),
            remedy=f"move the others away, or {_REMEDY}",
        )
    return wanted[0]


def _scene(folder: Path, n_cameras: int) -> Path:
    """The calibration of the nearest folder that has one; of several, that with as many cameras as files."""
    for place in (folder, *folder.parents):
        scenes = sorted(place.glob(SCENES))
        if len(scenes) == 1:
            return scenes[0]
        if scenes:
            fitting = [s for s in scenes if s.name.startswith(f"{n_cameras}_")]
            if len(fitting) == 1:
                return fitting[0]
            raise InputError(
                "There are several calibrations; which one is meant?",
                file=scenes[0].parent,
                expected=f"one {n_cameras}_cam_scene_sba.json for the {n_cameras} keypoint files",
                found=", ".join(s.name for s in scenes),
                remedy=_REMEDY,
            )
    raise InputError(
        "There is no calibration for this AcinoSet folder.",
        file=folder,
        expected=f"{SCENES} in it or in a folder above",
        found="none",
        remedy=f"copy the scene there, or {_REMEDY}",
    )
