"""Calibration of a joystick: least, middle and greatest raw number of every axis, and its file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from acino_fte.data_tools.whole_text import write_text_whole
from acino_fte.errors import InputError

FORMAT = "acino-fte/joystick/1"
FILE_NAME = "joystick.json"
LEAST_TRAVEL = 50
"""Raw numbers from the middle to either end; less is a stick that was not moved, or a wire that is off."""
_REST_SPREAD = 0.1  # of the travel: a stick that is let go does not wander further
_CALIBRATE = "calibrate again: acino-fte rig drive --calibrate-joystick"


@dataclass(frozen=True)
class AxisCalibration:
    """One axis, in raw numbers of the converter; `low` counts as -1, and may be the greater number."""

    low: int
    centre: int
    high: int

    def __post_init__(self) -> None:
        if (self.high - self.centre) * (self.centre - self.low) <= 0 or self.travel < LEAST_TRAVEL:
            raise InputError(
                "The calibration of the joystick is impossible.",
                expected=f"the middle between both ends, at least {LEAST_TRAVEL} from either",
                found=f"{self.low}, {self.centre}, {self.high}",
                remedy=_CALIBRATE,
            )

    @property
    def travel(self) -> int:
        """Raw numbers to the nearer end."""
        return min(abs(self.high - self.centre), abs(self.centre - self.low))

    def deflection(self, raw: float) -> float:
        """Raw number as a share of the travel on its side: -1, 0 and 1 at the three calibrated places."""
        above = (raw - self.centre) * (self.high - self.centre) > 0
        return (raw - self.centre) / (self.high - self.centre if above else self.centre - self.low)


def calibrated(
    at_rest: Sequence[tuple[int, ...]], moved: Sequence[tuple[int, ...]]
) -> tuple[AxisCalibration, ...]:
    """Calibration of all axes.

    The middle is the median at rest. The ends are the second least and second greatest number, so that one
    wrong reading does not become an end.

    Parameters
    ----------
    at_rest : sequence of tuple
        Readings while nobody touches the stick.
    moved : sequence of tuple
        Readings while it is moved to all its ends.

    Raises
    ------
    InputError
        The stick was touched, or not moved to both ends of every axis.
    """
    rest, all_over = np.array(at_rest), np.array(moved)
    if rest.ndim != 2 or all_over.ndim != 2 or min(len(rest), len(all_over)) < 10:
        raise InputError("The joystick gave too few readings.", remedy=_CALIBRATE)
    axes = []
    for axis in range(rest.shape[1]):
        centre = round(float(np.median(rest[:, axis])))
        low, high = (int(np.sort(all_over[:, axis])[k]) for k in (1, -2))
        spread = float(np.ptp(np.sort(rest[:, axis])[1:-1]))
        if not low + LEAST_TRAVEL <= centre <= high - LEAST_TRAVEL:
            raise InputError(
                f"Axis {axis + 1} of the joystick was not moved to both ends, or its wire is off.",
                expected=f"at least {LEAST_TRAVEL} to either side of the middle, {centre}",
                found=f"{low} to {high}",
                remedy=_CALIBRATE,
            )
        if spread > _REST_SPREAD * (high - low):
            raise InputError(
                f"Axis {axis + 1} of the joystick moved while it was to rest.",
                found=f"raw numbers over {spread:.0f} of {high - low}",
                remedy=_CALIBRATE,
            )
        axes.append(AxisCalibration(low, centre, high))
    return tuple(axes)


def save_calibration(folder: Path, axes: Sequence[AxisCalibration]) -> Path:
    """Write ``joystick.json``, whole."""
    path = folder / FILE_NAME
    content = {"format": FORMAT, "axes": [asdict(axis) for axis in axes]}
    write_text_whole(path, json.dumps(content, indent=1) + "\n")
    return path


def load_calibration(folder: Path) -> tuple[AxisCalibration, ...] | None:
    """The calibration in ``joystick.json``; None if there is none.

    Raises
    ------
    InputError
        The file is damaged, or its numbers are impossible.
    """
    path = folder / FILE_NAME
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            raise ValueError("another format")
        axes = [(axis["low"], axis["centre"], axis["high"]) for axis in content["axes"]]
        if len(axes) < 2 or not all(type(number) is int for axis in axes for number in axis):
            raise ValueError("whole numbers of two axes are expected")
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            "The calibration of the joystick cannot be read.",
            file=path,
            found=str(error),
            remedy=_CALIBRATE,
        ) from None
    return tuple(AxisCalibration(*axis) for axis in axes)
