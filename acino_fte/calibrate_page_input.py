"""What the calibration page shows: images, each with the point cloud that the lidar saw at that time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from acino_fte.errors import InputError
from acino_fte.extras import load_cv2

MOST_POINTS = 2_000_000
"""Points that the page shows of a cloud; of a larger one every second, third, … point."""
_SHOWN = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg"}
_REMEDY = 'pip install "acino-fte[lidar]"'


@dataclass(frozen=True, eq=False)
class Placement:
    """One image and its point cloud: one place of the target. K points.

    Attributes
    ----------
    name : str
        Of the image, as the pairs have it.
    picture : bytes
        The image as browsers show it (PNG or JPEG).
    media_type : str
        ``image/png`` or ``image/jpeg``.
    resolution : (width, height)
        px.
    xyz : (K, 3)
        m, frame of the lidar.
    intensity : (K,)
    """

    name: str
    picture: bytes
    media_type: str
    resolution: tuple[int, int]
    xyz: np.ndarray
    intensity: np.ndarray

    def packed(self) -> bytes:
        """The cloud as the page takes it: xyz, then intensity, float32."""
        return self.xyz.astype("<f4").tobytes() + self.intensity.astype("<f4").tobytes()


def placement(
    name: str, image: Path | str | np.ndarray, xyz: np.ndarray, intensity: np.ndarray | None = None
) -> Placement:
    """An image and its cloud as the page shows them.

    Parameters
    ----------
    name : str
        Of the image.
    image : Path or array
        A file that OpenCV reads, or pixels (H, W) or (H, W, 3) as red, green, blue; deep images are
        stretched to 8 bits.
    xyz : (K, 3)
        m, frame of the lidar. Points at the lidar itself and those that are not finite are left out.
    intensity : (K,), optional
        Of the points; 0 where it is not known.

    Raises
    ------
    InputError
        The image cannot be read, or the cloud has no points.
    """
    picture, media_type, resolution = (
        _from_array(image) if isinstance(image, np.ndarray) else _from_file(image)
    )
    xyz = np.asarray(xyz, dtype=float).reshape(-1, 3)
    value = np.zeros(len(xyz)) if intensity is None else np.asarray(intensity, dtype=float)
    if value.shape != (len(xyz),):
        raise InputError(
            "Points and intensities do not fit together.",
            expected=f"{len(xyz)}",
            found=f"shape {value.shape}",
        )
    kept = np.flatnonzero(np.isfinite(xyz).all(axis=1) & xyz.any(axis=1))
    if not len(kept):
        raise InputError(
            f"The cloud of the image '{name}' is empty.",
            expected="returns of the lidar, m",
            found=f"{len(xyz)} points, none of them anywhere",
        )
    kept = kept[:: -(-len(kept) // MOST_POINTS)]
    return Placement(name, picture, media_type, resolution, xyz[kept], np.nan_to_num(value[kept]))


def read_placements(images: Sequence[Path], clouds: Sequence[Path]) -> list[Placement]:
    """Images and their clouds from files: one cloud an image, or one for all.

    Raises
    ------
    InputError
        A file cannot be read, or the numbers of files do not fit.
    """
    from acino_fte.calibrate_page_clouds import read_cloud

    if len(clouds) not in (1, len(images)) or not images:
        raise InputError(
            "Every image needs its point cloud.",
            key="--cloud",
            expected="1 cloud" + (f", or {len(images)}: one for each image, in order" * (len(images) > 1)),
            found=str(len(clouds)),
            remedy="give --cloud once for every image",
        )
    read = {path: read_cloud(path) for path in dict.fromkeys(clouds)}
    each = list(clouds) * (len(images) if len(clouds) == 1 else 1)
    placements = [
        placement(image.name, image, *read[cloud]) for image, cloud in zip(images, each, strict=True)
    ]
    check_placements(placements)
    return placements


def check_placements(placements: Sequence[Placement]) -> None:
    """Raise InputError where images are missing, named alike, or of different size."""
    if not placements:
        raise InputError("There is nothing to calibrate.", expected="an image and a point cloud")
    names = [one.name for one in placements]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise InputError("Two images have one name.", found=twice[0], remedy="rename one of them")
    sizes = {one.resolution for one in placements}
    if len(sizes) > 1:
        raise InputError(
            "The images have different sizes.",
            expected="images of one camera at one zoom",
            found=", ".join("{} × {}".format(*size) for size in sorted(sizes)),
            remedy="calibrate them one after the other",
        )


def _from_file(path: Path | str) -> tuple[bytes, str, tuple[int, int]]:
    path = Path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError("The image cannot be read.", file=path, found=str(error)) from error
    cv2 = load_cv2()
    pixels = (
        cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR)
        if content
        else None
    )
    if pixels is None:
        raise InputError("The file is no image.", file=path, expected="PNG, JPEG, TIFF, …")
    media_type = _SHOWN.get(path.suffix.lower())
    if media_type and pixels.dtype == np.uint8:
        return content, media_type, (pixels.shape[1], pixels.shape[0])
    return _from_array(pixels[..., ::-1])


def _from_array(pixels: np.ndarray) -> tuple[bytes, str, tuple[int, int]]:
    """PNG of pixels; deep ones are stretched over the middle 99.8 % of their values."""
    cv2 = load_cv2()
    if pixels.dtype != np.uint8:
        low, high = np.percentile(pixels, [0.1, 99.9])
        pixels = np.clip((pixels - low) * (255.0 / max(high - low, 1e-9)), 0, 255).astype(np.uint8)
    ordered = pixels if pixels.ndim == 2 else pixels[..., 2::-1]
    _, png = cv2.imencode(".png", np.ascontiguousarray(ordered), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return png.tobytes(), "image/png", (pixels.shape[1], pixels.shape[0])
