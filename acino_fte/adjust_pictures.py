"""Pictures for the page of adjustments: frames of videos, or of folders with an image a frame, as JPEG."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock

import numpy as np

from acino_fte.errors import InputError, did_you_mean
from acino_fte.evaluation_runs import Run
from acino_fte.extras import load_cv2

_QUALITY = 88
_ASPECT = 0.01


@dataclass
class Pictures:
    """Frames by camera; one at a time is decoded.

    Attributes
    ----------
    sources : dict
        What gives the pixels (H, W) or (H, W, 3), red green blue, of a frame, by camera.
    """

    sources: dict[str, Callable[[int], np.ndarray]] = field(default_factory=dict)
    _lock: Lock = field(default_factory=Lock)

    def jpeg(self, camera: str, frame: int) -> bytes:
        """A frame as JPEG; empty where there is none."""
        with self._lock:
            try:
                pixels = self.sources[camera](frame)
            except InputError:
                return b""
        return as_jpeg(pixels)


def as_jpeg(pixels: np.ndarray) -> bytes:
    """Pixels (H, W) or (H, W, 3), uint8 or uint16, as JPEG."""
    cv2 = load_cv2()
    if pixels.dtype == np.uint16:
        top = max(1, int(pixels.max()))
        pixels = (pixels.astype(np.uint32) * 255 // top).astype(np.uint8)
    if pixels.ndim == 3:
        pixels = np.ascontiguousarray(pixels[..., ::-1])
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()


def pictures_of_run(run: Run, videos: Sequence[str], folders: Sequence[str]) -> Pictures:
    """Open what was given as ``CAMERA=VIDEO`` and ``[CAMERA=]FOLDER``, and look at its first picture.

    Raises
    ------
    InputError
        A camera, a video or a folder does not exist, it has no picture of the run's first frame, or
        pictures of another shape than the camera's. Smaller ones are enlarged.
    """
    pictures = Pictures()
    for text in videos:
        camera, path = _named(text, run, "--video")
        _add(pictures, run, camera, _source(path), path, "--video")
    for text in folders:
        for camera, path in _image_folders(text, run).items():
            _add(pictures, run, camera, _source(path), path, "--images")
    return pictures


def _add(
    pictures: Pictures, run: Run, camera: str, source: Callable[[int], np.ndarray], path: Path, key: str
) -> None:
    if camera in pictures.sources:
        raise InputError(f"Camera '{camera}' has pictures twice.", file=path, key=key, remedy="leave one out")
    first = int(run.frames[0])
    pixels = source(first)
    width, height = run.cameras[camera].resolution
    if abs(pixels.shape[1] * height / (pixels.shape[0] * width) - 1) > _ASPECT:
        raise InputError(
            f"The pictures are not of camera '{camera}' as it was calibrated.",
            file=path,
            key=key,
            expected=f"{width} x {height} px, or smaller of the same shape",
            found=f"{pixels.shape[1]} x {pixels.shape[0]} px",
            remedy="give the video that the keypoints were found in",
        )
    pictures.sources[camera] = source


def _named(text: str, run: Run, key: str) -> tuple[str, Path]:
    camera, equals, path = text.partition("=")
    if not equals and len(run.camera_names) == 1:
        return run.camera_names[0], Path(text).expanduser()
    if not equals or camera not in run.camera_names:
        hint = did_you_mean(camera, run.camera_names) if equals else ""
        raise InputError(
            f"The run has no camera '{camera}'{hint}"
            if equals
            else "It is not clear of which camera this is.",
            key=key,
            expected=f"CAMERA=FILE with CAMERA one of {', '.join(run.camera_names)}",
            found=text,
        )
    return camera, Path(path).expanduser()


def _source(path: Path) -> Callable[[int], np.ndarray]:
    """Pixels by frame of a video or of a folder of images.

    Images numbered from 0 or 1 without a gap are taken in their order; others are known by the last number in
    their names, which is the frame.
    """
    from acino_fte.data_tools.pictures import PictureFolder, open_pictures

    pictures = open_pictures(path)
    places: dict[int, int] = {}
    if isinstance(pictures, PictureFolder):
        numbers = [re.findall(r"\d+", file.stem) for file in pictures.files]
        if all(numbers):
            places = {int(found[-1]): place for place, found in enumerate(numbers)}
            if sorted(places) in (list(range(len(numbers))), list(range(1, len(numbers) + 1))):
                places = {}

    def read(frame: int) -> np.ndarray:
        if places and frame not in places:
            raise InputError(
                "There is no picture of this frame.",
                file=path,
                key=f"frame {frame}",
                expected="images with the frame as the last number of their names, counted from 0",
                found=f"frames {min(places)} to {max(places)}",
                remedy="name the images by their frames",
            )
        return pictures.at(places.get(frame, frame)).pixels

    return read


def _image_folders(text: str, run: Run) -> dict[str, Path]:
    """Folders of images by camera: one that is named, or those called as the cameras in a folder."""
    whole = Path(text).expanduser()
    if whole.is_dir():
        found = {name: whole / name for name in run.camera_names if (whole / name).is_dir()}
        if found:
            return found
        if len(run.camera_names) == 1:
            return {run.camera_names[0]: whole}
        raise InputError(
            "The folder has no pictures of a camera of the run.",
            file=whole,
            key="--images",
            expected=f"folders called {', '.join(run.camera_names)} in it, or CAMERA=FOLDER",
            found=", ".join(sorted(p.name for p in whole.iterdir())[:5]) or "nothing",
        )
    camera, path = _named(text, run, "--images")
    if not path.is_dir():
        raise InputError(
            "The folder of images does not exist.", file=path, key="--images", remedy="check the path"
        )
    return {camera: path}
