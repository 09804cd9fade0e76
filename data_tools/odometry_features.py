"""Points that pictures share: SIFT features, where they lie in the camera's frame, and their matches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acino_fte.cameras import Camera
from acino_fte.extras import load_cv2


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one picture. K features.

    Attributes
    ----------
    bearing : (K, 2)
        Normalised coordinates, x/z and y/z, free of distortion.
    descriptor : (K, 128) float32
        RootSIFT, of unit length.
    """

    bearing: np.ndarray
    descriptor: np.ndarray

    def __len__(self) -> int:
        return len(self.bearing)


def find_features(
    pixels: np.ndarray, camera: Camera, boxes: np.ndarray | None, *, most: int, longest_side: int
) -> Features:
    """SIFT features (Lowe 2004) outside boxes, the strongest first, as RootSIFT (Arandjelović, Zisserman
    2012).

    Parameters
    ----------
    pixels : (H, W) or (H, W, 3)
        Grey, or red, green, blue; as wide as the camera's pictures, or narrower with the same field of view.
    camera : Camera
        Its lens takes the distortion away; features outside its valid field are left out.
    boxes : (B, 4), optional
        Left, top, right, bottom, px of the camera, of what moves by itself; NaN for none.
    most : int
        Features at most.
    longest_side : int
        Larger pictures are made smaller before, px.
    """
    cv2 = load_cv2()
    grey = _grey(pixels)
    share = min(1.0, longest_side / max(grey.shape))
    if share < 1.0:
        grey = cv2.resize(grey, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    whole = camera.resolution[0] / pixels.shape[1]
    mask = _mask(grey.shape, boxes, share / whole)
    detector = cv2.SIFT_create(nfeatures=most, contrastThreshold=0.02)
    points, descriptor = detector.detectAndCompute(grey, mask)
    if descriptor is None or not len(points):
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    factor = np.array(pixels.shape[1::-1]) / np.array(grey.shape[::-1])
    place = (np.array([p.pt for p in points]) + 0.5) * (factor * whole) - 0.5
    bearing = camera.undistort(place)
    descriptor = np.sqrt(descriptor / np.maximum(descriptor.sum(1, keepdims=True), 1e-9))
    seen = np.isfinite(bearing).all(1)
    return Features(bearing[seen], descriptor[seen].astype(np.float32))


def _grey(pixels: np.ndarray) -> np.ndarray:
    """The picture as grey uint8; deep pictures are stretched to what they hold."""
    deep = pixels.dtype == np.uint16
    if pixels.ndim == 3:
        pixels = pixels.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels)
    if deep:
        top = max(float(np.percentile(pixels, 99.9)), 1.0)
        pixels = pixels * (255.0 / top)
    return np.clip(np.rint(pixels), 0, 255).astype(np.uint8)


def _mask(shape: tuple[int, ...], boxes: np.ndarray | None, share: float) -> np.ndarray | None:
    if boxes is None:
        return None
    mask = np.full(shape, 255, np.uint8)
    for box in np.atleast_2d(boxes):
        if np.isfinite(box).all():
            left, top = np.maximum(np.floor(box[:2] * share), 0).astype(int)
            right, bottom = np.maximum(np.ceil(box[2:] * share), -1).astype(int)
            mask[top : bottom + 1, left : right + 1] = 0
    return mask


def keypoint_boxes(pixels: np.ndarray, margin: float = 0.25) -> np.ndarray:
    """Boxes (N, 4) around an animal's markers (N, M, 2), px, wider by a share of their longer side.

    Left, top, right, bottom; NaN where a frame has no marker. Frames without markers take the box of the
    nearest frame with some.
    """
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(pixels).all(-1)
    low = np.where(seen[..., None], pixels, np.inf).min(1)
    high = np.where(seen[..., None], pixels, -np.inf).max(1)
    with np.errstate(invalid="ignore"):
        wide = margin * np.maximum((high - low).max(1), 16.0)[:, None]
    boxes = np.concatenate([low - wide, high + wide], axis=1)
    rows = np.flatnonzero(seen.any(1))
    if not len(rows):
        return np.full((len(pixels), 4), np.nan)
    nearest = rows[np.abs(np.arange(len(pixels))[:, None] - rows).argmin(1)]
    return boxes[nearest]


def match_features(a: Features, b: Features, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a and of b that match: nearest of each other, and by the ratio nearer than any second."""
    none = np.zeros(0, dtype=int)
    if len(a) < 2 or len(b) < 2:
        return none, none
    alike = a.descriptor @ b.descriptor.T
    best = alike.argmax(1)
    rows = np.arange(len(a))
    first = alike[rows, best]
    alike[rows, best] = -1.0
    second = alike.max(1)
    near, next_near = np.maximum(1.0 - first, 0.0), np.maximum(1.0 - second, 1e-12)  # half squared distances
    rows = np.flatnonzero(near < ratio**2 * next_near)
    best = best[rows]
    mutual = (b.descriptor[best] @ a.descriptor.T).argmax(1) == rows
    return rows[mutual], best[mutual]
