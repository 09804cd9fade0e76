"""A simulated camera: a pattern that moves, with the number of the frame burnt in."""

from __future__ import annotations

from collections.abc import Sequence
from zlib import crc32

import numpy as np

from acino_fte.data_tools.recording import Picture, PictureInfo
from acino_fte.rig.faults import Fault
from acino_fte.rig.recorder_clock import Clock
from acino_fte.rig.rig_file import CameraPart
from acino_fte.rig.simulated import SimulatedSource
from acino_fte.rig.sources import Sample, SourceStream

BITS = 24
"""Of the number of a frame, burnt in as a row of squares, the highest first: white is 1."""
_STEP, _MARGIN = 4, 512  # px: of the pattern from frame to frame, and how much wider it is


class SimulatedCamera(SimulatedSource):
    """A camera whose frames are parts of one prepared picture: cheap to make, and moving."""

    def __init__(self, name: str, part: CameraPart, clock: Clock, faults: Sequence[Fault] = ()) -> None:
        seed = crc32(name.encode())
        super().__init__(name, (SourceStream(name, "image", part.fps),), clock, faults, seed)
        self._part = part
        self._scene: np.ndarray | None = None
        self._seed = seed

    def open(self) -> None:
        """Connect, and prepare the pattern."""
        super().open()
        if self._scene is None:
            self._scene = _scene(self._part, self._seed)

    def sample(self, stream: SourceStream, number: int, device_ns: int) -> Sample:
        """A picture and what the driver says of it."""
        if self._scene is None:
            raise RuntimeError("the camera is not open")
        start = _STEP * number % (_MARGIN + 1)
        pixels = self._scene[:, start : start + self._part.width].copy()
        burn_number(pixels, number)
        info = PictureInfo(device_ns, number, self._part.exposure_us, 0.0)
        return Sample(stream.name, Picture(device_ns, pixels, number), device_ns, number, info)


def _scene(part: CameraPart, seed: int) -> np.ndarray:
    """(height, width + margin): hills of grey with a little noise; 16 bits for more than 8."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: part.height, : part.width + _MARGIN].astype(np.float32)
    grey = (
        0.5 + 0.22 * np.sin(x / 37) + 0.18 * np.sin(y / 23) + 0.01 * rng.standard_normal(x.shape, np.float32)
    )
    top = (1 << part.bits) - 1
    return np.clip(grey * top, 0, top).astype(np.uint8 if part.bits <= 8 else np.uint16)


def _side(shape: tuple[int, ...]) -> int:
    """Of a square of the number, px."""
    return max(min(shape[1] // BITS, 16), 1)


def burn_number(pixels: np.ndarray, number: int) -> None:
    """Write the number of a frame into its upper left corner."""
    side = _side(pixels.shape)
    bits = (number >> np.arange(BITS - 1, -1, -1)) & 1
    white = 255 if pixels.dtype == np.uint8 else int(pixels.max())
    pixels[:side, : BITS * side] = np.repeat(bits * white, side)[: pixels.shape[1]]


def burnt_number(pixels: np.ndarray) -> int:
    """Read the number of a frame, (H, W) or (H, W, 3), also after a lossy codec."""
    grey = pixels if pixels.ndim == 2 else pixels[..., 1]
    side = _side(grey.shape)
    squares = grey[:side, : BITS * side].reshape(side, BITS, side).mean(axis=(0, 2))
    bits = squares > (127 if grey.dtype == np.uint8 else grey.max() / 2)
    return int(bits @ (1 << np.arange(BITS - 1, -1, -1)))
