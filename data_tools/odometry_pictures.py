"""Pictures of a camera from a video or a folder of images, by number."""

from __future__ import annotations

from pathlib import Path

from acino_fte.data_tools.odometry_features import Pictures, imported_cv2
from acino_fte.data_tools.recording import Picture
from acino_fte.errors import InputError

_IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")


class ImageFolder:
    """The images of a folder in the order of their names, read when they are asked for; grey.

    Parameters
    ----------
    folder : Path
        With images of one size.

    Raises
    ------
    InputError
        It holds no image.
    """

    def __init__(self, folder: Path | str) -> None:
        self._cv2 = imported_cv2()
        self.paths = sorted(p for p in Path(folder).iterdir() if p.suffix.lower() in _IMAGES)
        if not self.paths:
            raise InputError(
                "The folder holds no images.",
                file=folder,
                expected=f"files such as 000000.png ({', '.join(_IMAGES)})",
                remedy="check the path",
            )

    def __len__(self) -> int:
        return len(self.paths)

    def at(self, n: int) -> Picture:
        """Image number n.

        Raises
        ------
        InputError
            It cannot be read.
        """
        pixels = self._cv2.imread(str(self.paths[n]), self._cv2.IMREAD_GRAYSCALE)
        if pixels is None:
            raise InputError("An image cannot be read.", file=self.paths[n], remedy="copy it again")
        return Picture(n, pixels, n)


def open_pictures(path: Path | str) -> Pictures:
    """Pictures of a video file or of a folder of images.

    Raises
    ------
    InputError
        There is nothing, or nothing that can be read.
    """
    path = Path(path).expanduser()
    if path.is_dir():
        return ImageFolder(path)
    if not path.is_file():
        raise InputError("The video does not exist.", file=path, remedy="check the path")
    from acino_fte.data_tools.video import VideoReader

    return VideoReader(path)
