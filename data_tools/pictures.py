"""Pictures one after another, by number: of a video, or of a folder of image files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from acino_fte.data_tools.recording import Picture
from acino_fte.data_tools.video import VIDEO_SUFFIXES, VideoReader
from acino_fte.errors import InputError
from acino_fte.extras import load_cv2

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")


class NumberedPictures(Protocol):
    """What odometry asks of pictures."""

    def __len__(self) -> int: ...

    def at(self, frame: int) -> Picture:
        """The picture of this number, from 0."""


class Pictures(NumberedPictures, Protocol):
    """Pictures of a file or folder."""

    @property
    def fps(self) -> float | None:
        """Frames per second; None where nothing says it."""

    def close(self) -> None:
        """Close the files."""

    def __enter__(self) -> Any: ...

    def __exit__(self, *_: object) -> None: ...


def open_pictures(path: Path | str, fps: float | None = None) -> Pictures:
    """Open a video, a folder of images or one image.

    Parameters
    ----------
    path : Path
        A folder is read in natural order: ``frame2.png`` before ``frame10.png``.
    fps : float, optional
        Frames per second of a folder.

    Raises
    ------
    InputError
        There is nothing of that name, or no picture in it.
    """
    path = Path(path)
    if path.is_dir():
        return PictureFolder(path, fps)
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return PictureFolder(path, fps)
    if not path.exists():
        raise InputError(
            "There are no such pictures.",
            file=path,
            expected="a video or a folder of images",
            found="nothing",
            remedy="check the path",
        )
    return VideoReader(path)


def natural_order(name: str) -> list[tuple[int, int, str]]:
    """A key to sort by that takes digits as numbers."""
    return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in re.split(r"(\d+)", name.lower()) if p]


class PictureList:
    """Pictures in memory as :class:`NumberedPictures`: arrays (H, W) or (H, W, 3), or :class:`Picture`."""

    def __init__(self, pictures: Sequence[Any]) -> None:
        self._pictures = pictures

    def __len__(self) -> int:
        return len(self._pictures)

    def at(self, frame: int) -> Picture:
        """The picture of this number, from 0."""
        picture = self._pictures[frame]
        return picture if isinstance(picture, Picture) else Picture(frame, np.asarray(picture))


class PictureFolder:
    """Images of a folder as :class:`Pictures`.

    Parameters
    ----------
    path : Path
        The folder, or one image.
    fps : float, optional
        Frames per second; without it all times are zero.

    Raises
    ------
    InputError
        There is no image.
    """

    def __init__(self, path: Path | str, fps: float | None = None) -> None:
        self.path, self._fps = Path(path), fps
        found = self.path.iterdir() if self.path.is_dir() else [self.path]
        images = [f for f in found if f.suffix.lower() in IMAGE_SUFFIXES and f.is_file()]
        self.files = tuple(
            sorted((f for f in images if not f.name.startswith(".")), key=lambda f: natural_order(f.name))
        )
        if not self.files:
            videos = [f.name for f in self.path.glob("*") if f.suffix.lower() in VIDEO_SUFFIXES]
            raise InputError(
                "There are no pictures.",
                file=self.path,
                expected="a video or a folder of " + ", ".join(IMAGE_SUFFIXES),
                remedy=f"name the video itself: {videos[0]}" if videos else None,
            )

    @property
    def fps(self) -> float | None:
        """Frames per second as they were given."""
        return self._fps

    def __len__(self) -> int:
        return len(self.files)

    def at(self, frame: int) -> Picture:
        """The picture of this number, from 0.

        Raises
        ------
        InputError
            There is no such picture, or it cannot be read.
        """
        cv2 = load_cv2()
        if not 0 <= frame < len(self.files):
            raise InputError(
                "There is no such picture.",
                file=self.path,
                key=f"frame {frame}",
                expected=f"0 to {len(self.files) - 1}",
            )
        file = self.files[frame]
        try:
            data = np.fromfile(file, np.uint8)
        except OSError as error:
            raise InputError("The image cannot be read.", file=file, found=str(error)) from error
        pixels = cv2.imdecode(data, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH) if len(data) else None
        if pixels is None:
            raise InputError(
                "The image cannot be read.", file=file, expected="a whole image", found=f"{len(data)} bytes"
            )
        if pixels.ndim == 3:
            pixels = np.ascontiguousarray(pixels[..., 2::-1])
        time_ns = round(frame / self._fps * 1e9) if self._fps else 0
        return Picture(time_ns, pixels, frame)

    def close(self) -> None:
        """Nothing is open."""

    def __enter__(self) -> PictureFolder:
        return self

    def __exit__(self, *_: object) -> None:
        return
