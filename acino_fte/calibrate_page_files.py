"""The picks of the calibration page on disk: written after every change, found again by the next session.

PAIRS.csv
    The complete pairs, as :func:`acino_fte.data_tools.lidar_pairs.read_lidar_pairs` reads them.
PAIRS.picking.json
    Beside it, while there are some: the pairs under way, one side picked.

Each is written whole or not at all, so that a process that is killed loses nothing but a change under way.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from acino_fte.calibrate_page_model import Pair, Picks, as_lidar_pairs, from_lidar_pairs
from acino_fte.data_tools.lidar_pairs import read_lidar_pairs, write_lidar_pairs
from acino_fte.data_tools.whole_text import write_text_whole
from acino_fte.errors import InputError

FORMAT = "acino-fte/picking/1"


def save_picks(path: Path, picks: Picks) -> None:
    """Write the picks to a file of pairs, and those under way beside it.

    Raises
    ------
    InputError
        They cannot be written.
    """
    write_lidar_pairs(path, as_lidar_pairs(picks.pairs))
    beside = _beside(path)
    if picks.half:
        halves = [{"image": h.image, "pixel": h.pixel, "xyz": h.xyz} for h in picks.half.values()]
        write_text_whole(beside, json.dumps({"format": FORMAT, "half": halves}, indent=1) + "\n")
    else:
        beside.unlink(missing_ok=True)


def read_picks(path: Path, images: Sequence[str]) -> Picks:
    """The picks of a file of pairs, and those under way beside it; none where there are no files.

    Parameters
    ----------
    path : Path
        The file of pairs.
    images : sequence of str
        Names of the images that are shown. Pairs that name no image are taken for the only one.

    Raises
    ------
    InputError
        A file is broken, or there are pairs of an image that is not shown.
    """
    pairs = from_lidar_pairs(read_lidar_pairs(path)) if path.exists() else ()
    if len(images) == 1:
        pairs = tuple(_named(pair, images[0]) for pair in pairs)
    for number, pair in enumerate(pairs, start=1):
        if pair.image not in images:
            raise InputError(
                f"Pair {number} is of the image '{pair.image}', which is not shown.",
                file=path,
                key="image",
                expected=", ".join(images),
                found=pair.image or "no image",
                remedy="give that image too, or another file for the pairs",
            )
    return Picks(pairs, {half.image: half for half in _halves(_beside(path)) if half.image in images})


def _beside(path: Path) -> Path:
    return path.with_name(path.stem + ".picking.json")


def _named(pair: Pair, image: str) -> Pair:
    return pair if pair.image else Pair(image, pair.pixel, pair.xyz, pair.used, pair.label)


def _halves(path: Path) -> list[Pair]:
    if not path.exists():
        return []
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["format"] != FORMAT:
            raise ValueError(f"format {data['format']!r}")
        halves = [
            Pair(str(row["image"]), _numbers(row["pixel"], 2), _numbers(row["xyz"], 3))
            for row in data["half"]
        ]
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(
            "The file of pairs under way cannot be read.",
            file=path,
            found=f"{type(error).__name__}: {error}",
            remedy="delete it: whole pairs are in the file beside it",
        ) from error
    return [half for half in halves if not half.complete and (half.pixel or half.xyz)]


def _numbers(value: Any, count: int) -> Any:
    if value is None:
        return None
    if len(value) != count:
        raise ValueError(f"{len(value)} numbers, not {count}")
    return tuple(float(number) for number in value)
