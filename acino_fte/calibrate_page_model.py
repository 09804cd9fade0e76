"""What was picked on the calibration page, with undo: no browser, no files, no solving."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from acino_fte.data_tools.lidar_pairs import LidarPairs
from acino_fte.errors import InputError

UNDO_DEPTH = 1000
Pixel = tuple[float, float]
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Pair:
    """One place that was picked in an image, in its cloud, or in both.

    Attributes
    ----------
    image : str
        Name of the image.
    pixel : (u, v), optional
        px, centre of the first pixel at 0.
    xyz : (x, y, z), optional
        m, frame of the lidar.
    used : bool
        False for a pair that was dropped: it is kept and ignored.
    label : str
    """

    image: str
    pixel: Pixel | None = None
    xyz: Point | None = None
    used: bool = True
    label: str = ""

    @property
    def complete(self) -> bool:
        """Whether both sides were picked."""
        return self.pixel is not None and self.xyz is not None


@dataclass(frozen=True)
class Picks:
    """All picks at one time; what undo goes back to.

    Attributes
    ----------
    pairs : tuple of Pair
        Complete pairs, in the order of their numbers (1, 2, …).
    half : mapping of str to Pair
        The pair under way of each image, one side of it picked.
    """

    pairs: tuple[Pair, ...] = ()
    half: Mapping[str, Pair] = field(default_factory=dict)


class PickBook:
    """The picks of a session: add, pick again, drop, delete, undo.

    A pick on one side begins a pair, one on the other side completes it; a second one on the same side
    moves the first. Pairs are named by their number, as they stand in the file: from 1.

    Parameters
    ----------
    images : sequence of str
        Names of the images.
    picks : Picks
        To begin with.
    changed : callable, optional
        Called after every change, undo included; where it fails, the change is taken back.
    """

    def __init__(
        self,
        images: tuple[str, ...],
        picks: Picks | None = None,
        changed: Callable[[Picks], object] | None = None,
    ) -> None:
        self.images = images
        self.picks = picks or Picks()
        self.changed = changed
        self._before: list[Picks] = []
        self._after: list[Picks] = []
        self.redoing: int | None = None
        """Number of the pair whose picks are taken again, if any."""

    # -- reading ---------------------------------------------------------------------------------------
    @property
    def pairs(self) -> tuple[Pair, ...]:
        """The complete pairs."""
        return self.picks.pairs

    @property
    def can_undo(self) -> bool:
        """Whether there is a change to take back."""
        return bool(self._before)

    @property
    def can_redo(self) -> bool:
        """Whether there is a change that was taken back."""
        return bool(self._after)

    def pair(self, number: int) -> Pair:
        """The pair of a number."""
        if not 1 <= number <= len(self.pairs):
            raise InputError(
                f"There is no pair {number}.", expected=f"1 to {len(self.pairs)}", found=str(number)
            )
        return self.pairs[number - 1]

    def half(self, image: str) -> Pair | None:
        """The pair under way in an image."""
        return self.picks.half.get(image)

    def lidar_pairs(self) -> LidarPairs:
        """The complete pairs as the solver and the file take them."""
        return as_lidar_pairs(self.pairs)

    # -- changing --------------------------------------------------------------------------------------
    def pick(self, image: str, pixel: Pixel | None = None, xyz: Point | None = None) -> int | None:
        """Take a pick in an image or in its cloud.

        Returns
        -------
        int, optional
            Number of the pair that it completed or moved; None while the pair has one side.
        """
        if image not in self.images:
            raise InputError(f"There is no image '{image}'.", expected=", ".join(self.images), found=image)
        given: dict[str, Any] = {
            key: value for key, value in (("pixel", pixel), ("xyz", xyz)) if value is not None
        }
        if self.redoing is not None:
            number = self.redoing
            if self.pair(number).image != image:
                raise InputError(
                    f"Pair {number} is in the image '{self.pair(number).image}'.",
                    remedy=f"show that image, or press Escape to stop redoing pair {number}",
                )
            self._replace(number, **given)
            return number
        half = replace(self.half(image) or Pair(image), **given)
        others = {name: pair for name, pair in self.picks.half.items() if name != image}
        if not half.complete:
            self._set(Picks(self.pairs, others | {image: half}))
            return None
        self._set(Picks((*self.pairs, half), others))
        return len(self.pairs)

    def nudge(self, image: str, du: float, dv: float) -> bool:
        """Move the image's pick under way, or else that of the pair being redone, by some pixels."""
        pair = self.pair(self.redoing) if self.redoing is not None else self.half(image)
        if pair is None or pair.pixel is None or pair.image != image:
            return False
        self.pick(image, pixel=(pair.pixel[0] + du, pair.pixel[1] + dv))
        return True

    def use(self, number: int, used: bool) -> None:
        """Drop a pair, or take it back in."""
        self._replace(number, used=used)

    def label(self, number: int, text: str) -> None:
        """Say what was picked."""
        self._replace(number, label=" ".join(text.split()))

    def delete(self, number: int) -> None:
        """Remove a pair; those after it move up by one."""
        self.pair(number)
        self.redoing = None
        self._set(replace(self.picks, pairs=self.pairs[: number - 1] + self.pairs[number:]))

    def discard_half(self, image: str) -> bool:
        """Forget the pair under way in an image; False where there is none."""
        if self.half(image) is None:
            return False
        others = {name: pair for name, pair in self.picks.half.items() if name != image}
        self._set(replace(self.picks, half=others))
        return True

    def redo_pair(self, number: int | None) -> None:
        """Have the next picks replace those of a pair; None to stop."""
        if number is not None:
            self.pair(number)
        self.redoing = number

    def escape(self, image: str) -> bool:
        """Stop redoing a pair, or else forget the one under way; False where there was nothing to stop."""
        if self.redoing is not None:
            self.redoing = None
            return True
        return self.discard_half(image)

    def undo(self) -> bool:
        """Take the last change back; False where there is none."""
        return self._go(self._before, self._after)

    def redo(self) -> bool:
        """Make the change again that was taken back last; False where there is none."""
        return self._go(self._after, self._before)

    # -- inside ----------------------------------------------------------------------------------------
    def _replace(self, number: int, **values: object) -> None:
        pair = replace(self.pair(number), **values)  # type: ignore[arg-type]
        if pair == self.pair(number):
            return
        pairs = (*self.pairs[: number - 1], pair, *self.pairs[number:])
        self._set(replace(self.picks, pairs=pairs))

    def _set(self, picks: Picks) -> None:
        as_lidar_pairs(picks.pairs)  # refuses what a file could not hold
        if picks == self.picks:
            return
        before, self.picks = self.picks, picks
        try:
            self._tell()
        except BaseException:
            self.picks = before
            raise
        self._before = [*self._before, before][-UNDO_DEPTH:]
        self._after = []

    def _go(self, source: list[Picks], target: list[Picks]) -> bool:
        if not source:
            return False
        before, self.picks = self.picks, source[-1]
        self.redoing = None
        try:
            self._tell()
        except BaseException:
            self.picks = before
            raise
        target.append(before)
        source.pop()
        return True

    def _tell(self) -> None:
        if self.changed is not None:
            self.changed(self.picks)


def as_lidar_pairs(pairs: tuple[Pair, ...]) -> LidarPairs:
    """Complete pairs as the solver and the file take them."""
    return LidarPairs(
        np.array([pair.pixel for pair in pairs], dtype=float).reshape(-1, 2),
        np.array([pair.xyz for pair in pairs], dtype=float).reshape(-1, 3),
        tuple(pair.image for pair in pairs),
        np.array([pair.used for pair in pairs], dtype=bool),
        tuple(pair.label for pair in pairs),
    )


def from_lidar_pairs(pairs: LidarPairs) -> tuple[Pair, ...]:
    """Pairs of a file as the page holds them."""
    rows = zip(
        pairs.image, pairs.pixel.tolist(), pairs.xyz.tolist(), pairs.used_mask, pairs.label, strict=True
    )
    return tuple(
        Pair(image, (pixel[0], pixel[1]), (xyz[0], xyz[1], xyz[2]), bool(used), label)
        for image, pixel, xyz, used, label in rows
    )
