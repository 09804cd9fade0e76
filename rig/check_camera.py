"""What a camera's driver and its pictures tell: encoders, exposure, how bright the pictures are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from acino_fte.data_tools.recording import PictureInfo
from acino_fte.rig.check_types import CameraAccount

MOST = 500
"""Glitches, changes and the like that are told one by one."""
_BLOCK, _AROUND = 4096, 4
_STEP = 20  # counts: a smaller step between two frames may be a hand's
_ODD = 4.0  # times the steps about it
_LEAP = 1000  # counts in a frame: no motor and no hand is so fast, even if it stays there
_CHANGED = 0.02
_EVERY = 8  # px
_WHITE, _BLACK = 250 / 255, 5 / 255
_NEARLY_ALL = 0.9


class CameraCheck:
    """Takes the messages of one camera's driver.

    An encoder glitch is a step of more than 20 counts that is taken back within three frames, or of more than
    1000 counts that is not, and of more than four times any other step about it: a motor or a hand speeds up
    over more than one frame. Steps are per frame, so that dropped frames do not matter.

    Parameters
    ----------
    account : CameraAccount
        Is filled in.
    lens : sequence of (place, name, tolerance)
        Encoders that must stay where they stood at the start, counts.
    """

    def __init__(self, account: CameraAccount, lens: Sequence[tuple[int, str, float]] = ()) -> None:
        self.account, self._lens = account, lens
        self._rows: list[tuple[int, int, tuple[int, ...]]] = []
        self._old = 0
        self._exposure: float | None = None
        self._home: dict[int, float] = {}
        self._away: dict[int, list[int]] = {}

    def add(self, time_ns: int, info: PictureInfo) -> None:
        """Take one message."""
        account = self.account
        account.n += 1
        self._expose(time_ns, info.exposure_us)
        if info.encoders:
            self._rows.append((time_ns, info.number, info.encoders))
            if len(self._rows) >= _BLOCK:
                self._digest(last=False)

    def finish(self) -> None:
        """Nothing more comes."""
        self._digest(last=True)
        for place, (start, end, far) in list(self._away.items()):
            self._lens_back(place, start, end, far)

    def _expose(self, time_ns: int, exposure: float) -> None:
        account = self.account
        low, high = account.exposure_us or (exposure, exposure)
        account.exposure_us = min(low, exposure), max(high, exposure)
        before, self._exposure = self._exposure, exposure
        if before is not None and abs(exposure - before) > _CHANGED * max(before, 1.0):
            account.n_exposures += 1
            if len(account.exposures) < MOST:
                account.exposures.append((time_ns, before, exposure))

    def _digest(self, last: bool) -> None:
        rows = self._rows
        width = min((len(row[2]) for row in rows), default=0)
        if len(rows) < 3 or not width:
            return
        counts = np.array([row[2][:width] for row in rows], float)
        passed = np.maximum(np.diff([row[1] for row in rows]), 1)
        glitch = glitches(np.diff(counts, axis=0) / passed[:, None])
        stop = len(rows) if last else len(rows) - _AROUND
        for i, place in np.argwhere(glitch).tolist():
            if self._old <= i + 1 < stop:
                self._glitch(rows[i + 1][0], place, int(counts[i + 1, place] - counts[i, place]))
        for place, _, tolerance in self._lens:
            if place < width:
                self._follow(rows, _without_spikes(counts[:, place]), place, tolerance, (self._old, stop))
        self._rows = rows[stop - _AROUND :]
        self._old = _AROUND

    def _glitch(self, time_ns: int, place: int, size: int) -> None:
        self.account.n_glitches += 1
        if len(self.account.glitches) < MOST:
            self.account.glitches.append((time_ns, place, size))

    def _follow(
        self,
        rows: Sequence[tuple[int, int, tuple[int, ...]]],
        steady: np.ndarray,
        place: int,
        tolerance: float,
        part: tuple[int, int],
    ) -> None:
        """Note when an encoder is away from where it stood at the start."""
        home = self._home.setdefault(place, float(np.median(steady[:15])))
        far = np.abs(steady - home)
        for i in range(part[0], part[1]):
            if far[i] > tolerance:
                start, _, most = self._away.get(place, (rows[i][0], 0, 0))
                size = int(steady[i] - home)
                self._away[place] = [start, rows[i][0], size if abs(size) > abs(most) else most]
            elif place in self._away:
                start, _, most = self._away.pop(place)
                self._lens_back(place, start, rows[i][0], most)

    def _lens_back(self, place: int, start: int, end: int, far: int) -> None:
        if len(self.account.lens) < MOST:
            self.account.lens.append((start, end, place, far))


def _without_spikes(counts: np.ndarray) -> np.ndarray:
    """Counts (K,) by the median of seven: spikes of three frames are gone, steps stay where they are."""
    padded = np.pad(counts, 3, mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, 7), axis=1)


def glitches(steps: np.ndarray) -> np.ndarray:
    """(K, E) bool: steps (K, E) of encoders, counts per frame, that stand out from those about them.

    Of a spike, which goes and comes back, the first of the two steps counts.
    """
    size = np.abs(steps)
    padded = np.pad(size, ((3, 3), (0, 0)))
    around = np.stack([padded[3 + k : 3 + k + len(size)] for k in (-3, -2, -1, 1, 2, 3)])
    signed = np.pad(steps, ((3, 3), (0, 0)))
    spike = np.zeros(size.shape, bool)
    for j, k in ((3, 1), (4, 2), (5, 3)):
        back = np.abs(signed[3 + k : 3 + k + len(size)] + steps) < 0.5 * size
        around[j][back] = 0.0
        spike |= back
    return (size > _ODD * around.max(axis=0)) & ((spike & (size > _STEP)) | (size > _LEAP))


class Brightness:
    """How bright a camera's pictures are: shares of white and black pixels, of sampled pictures."""

    def __init__(self, account: CameraAccount) -> None:
        self._account = account
        self._over: list[float] = []
        self._under: list[float] = []

    def add(self, pixels: np.ndarray) -> None:
        """Take one picture (H, W) or (H, W, 3), uint8 or uint16."""
        part = pixels[::_EVERY, ::_EVERY]
        most = float(np.iinfo(pixels.dtype).max)
        level = part.max(axis=2) if part.ndim == 3 else part
        self._over.append(float((level >= _WHITE * most).mean()))
        self._under.append(float((level <= _BLACK * most).mean()))

    def finish(self) -> None:
        """Nothing more comes."""
        account = self._account
        account.pictures = len(self._over)
        if self._over:
            account.over, account.under = float(np.median(self._over)), float(np.median(self._under))
            account.bright = int((np.array(self._over) > _NEARLY_ALL).sum())
            account.dark = int((np.array(self._under) > _NEARLY_ALL).sum())
