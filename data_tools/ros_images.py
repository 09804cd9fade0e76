"""Images of ROS, raw and compressed, as arrays of red, green, blue or grey, and back."""

from __future__ import annotations

from typing import Any

import numpy as np

from acino_fte.extras import load_cv2

# ROS names a mosaic by its first two pixels of the first and the second row; OpenCV's older names begin at
# the second row and the second column.
_BAYER = {"rggb": "BG", "bggr": "RG", "gbrg": "GR", "grbg": "GB"}
_CHANNELS = {"mono8": 1, "8UC1": 1, "mono16": 1, "16UC1": 1, "rgb8": 3, "bgr8": 3, "8UC3": 3}
_CHANNELS |= {"rgba8": 4, "bgra8": 4, "8UC4": 4, "rgb16": 3, "bgr16": 3}


def picture_from_image(message: dict[str, Any]) -> np.ndarray:
    """Pixels of a raw image: (H, W) or (H, W, 3) red, green, blue.

    Raises
    ------
    ValueError
        The encoding is not known, or bytes are missing.
    """
    encoding = str(message["encoding"]).strip()
    bayer = encoding.startswith("bayer_")
    channels = 1 if bayer else _CHANNELS.get(encoding)
    if channels is None:
        raise ValueError(f"the encoding '{encoding}' is not known")
    deep = encoding.endswith("16") or encoding.startswith("16")
    height, width, step = int(message["height"]), int(message["width"]), int(message["step"])
    size = 2 if deep else 1
    data = np.ascontiguousarray(message["data"]).view(np.uint8)
    step = max(step, width * channels * size)
    if len(data) < height * step:
        raise ValueError(f"{height} rows of {step} bytes, but only {len(data)} bytes")
    rows = data[: height * step].reshape(height, step)[:, : width * channels * size]
    pixels = np.ascontiguousarray(rows)
    if deep:
        pixels = pixels.view(">u2" if message["is_bigendian"] else "<u2").astype(np.uint16)
    pixels = pixels.reshape((height, width) if channels == 1 else (height, width, channels))
    if bayer:
        return mosaic_to_colours(pixels, encoding)
    if encoding.startswith(("bgr", "8UC3", "8UC4")):
        pixels = pixels[..., 2::-1]
    return np.ascontiguousarray(pixels[..., :3] if channels > 1 else pixels)


def mosaic_to_colours(pixels: np.ndarray, encoding: str) -> np.ndarray:
    """Colours (H, W, 3) of the mosaic (H, W) of a sensor; `encoding` such as ``bayer_rggb8``."""
    cv2 = load_cv2()
    pattern = _BAYER.get(encoding[6:10])
    if pattern is None:
        raise ValueError(f"the encoding '{encoding}' is not known")
    return cv2.cvtColor(np.ascontiguousarray(pixels), getattr(cv2, f"COLOR_Bayer{pattern}2RGB"))


def picture_from_compressed(message: dict[str, Any]) -> np.ndarray:
    """Pixels of a JPEG or PNG image.

    Raises
    ------
    ValueError
        The bytes are no image.
    """
    cv2 = load_cv2()
    data = np.ascontiguousarray(message["data"]).view(np.uint8)
    try:
        pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    except cv2.error as error:
        raise ValueError(f"the image cannot be decoded ({error.err})") from error
    if pixels is None:
        raise ValueError(f"{len(data)} bytes are not an image in '{message['format']}'")
    if pixels.ndim == 3:
        return np.ascontiguousarray(pixels[..., 2::-1])
    encoding = str(message["format"]).split(";")[0].strip()
    return mosaic_to_colours(pixels, encoding) if encoding.startswith("bayer_") else pixels


def picture_to_message(pixels: np.ndarray) -> dict[str, Any]:
    """Fields of a raw image: rgb8, mono8 or mono16."""
    pixels = np.ascontiguousarray(pixels)
    deep = pixels.dtype == np.uint16
    return {
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "encoding": ("rgb" if pixels.ndim == 3 else "mono") + ("16" if deep else "8"),
        "is_bigendian": 0,
        "step": pixels[0].nbytes,
        "data": pixels.astype("<u2" if deep else "u1", copy=False).tobytes(),
    }


def compressed_to_message(pixels: np.ndarray, form: str) -> dict[str, Any]:
    """Fields of a compressed image: `form` is ``"png"`` or ``"jpeg"``."""
    cv2 = load_cv2()
    pixels = np.asarray(pixels)
    suffix = {"png": ".png", "jpeg": ".jpg", "jpg": ".jpg"}.get(form)
    if suffix is None:
        raise ValueError(f"images are written as png, jpeg or raw, not '{form}'")
    coloured = pixels.ndim == 3
    _, data = cv2.imencode(suffix, np.ascontiguousarray(pixels[..., ::-1] if coloured else pixels))
    return {
        "format": f"{'rgb8' if coloured else 'mono8'}; {suffix[1:]} compressed",
        "data": data.tobytes(),
    }
