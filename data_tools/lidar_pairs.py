"""Pairs of picks: one place seen in an image and in a lidar's point cloud, and their files (CSV, JSON)."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.data_tools.whole_text import write_text_whole
from acino_fte.errors import InputError, did_you_mean

FORMAT = "acino-fte/lidar-pairs/1"
COLUMNS = ("image", "u", "v", "x", "y", "z", "use", "label")
_NUMBERS = ("u", "v", "x", "y", "z")
_NO, _YES = ("0", "false", "no", "n"), ("1", "true", "yes", "y", "")
_REMEDY = "write one row a pair: image,u,v,x,y,z[,use,label], pixels and metres in the lidar's frame"


@dataclass(frozen=True, eq=False)
class LidarPairs:
    """Places picked in images and in the point cloud. P pairs.

    Parameters
    ----------
    pixel : (P, 2)
        px, centre of the first pixel at 0, in the image as it was recorded (not undistorted).
    xyz : (P, 3)
        m, frame of the lidar.
    image : sequence of str, optional
        Name of the image of each pair; one name serves for all.
    used : (P,) bool, optional
        False for pairs that were dropped by hand: they stay in the file.
    label : sequence of str, optional
        What was picked.

    Raises
    ------
    InputError
        Lengths differ, a number is not finite, or a pair comes twice.
    """

    pixel: np.ndarray
    xyz: np.ndarray
    image: tuple[str, ...] = ()
    used: np.ndarray | None = None
    label: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        pixel, xyz = np.array(self.pixel, dtype=float), np.array(self.xyz, dtype=float)
        if pixel.size == 0 and xyz.size == 0:
            pixel, xyz = pixel.reshape(0, 2), xyz.reshape(0, 3)
        n = len(pixel)
        used = np.ones(n, dtype=bool) if self.used is None else np.array(self.used, dtype=bool)
        values = {
            "pixel": pixel,
            "xyz": xyz,
            "used": used,
            "image": _names(self.image, n),
            "label": _names(self.label, n),
        }
        for key, value in values.items():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, key, value)
        _check(self)

    def __len__(self) -> int:
        return len(self.pixel)

    @property
    def distance(self) -> np.ndarray:
        """Distance of each place from the lidar (P,), m."""
        return np.linalg.norm(self.xyz, axis=1)

    @property
    def n_used(self) -> int:
        """Pairs that were not dropped by hand."""
        return int(np.sum(self.used_mask))

    @property
    def used_mask(self) -> np.ndarray:
        """Which pairs are used (P,), bool."""
        return np.ones(len(self), dtype=bool) if self.used is None else self.used

    @property
    def images(self) -> tuple[str, ...]:
        """Names of the images, each once, in the order of the pairs."""
        return tuple(dict.fromkeys(self.image))

    def take(self, rows: np.ndarray) -> LidarPairs:
        """Some of the pairs: indices, or a mask (P,)."""
        rows = np.arange(len(self))[rows]
        return LidarPairs(
            self.pixel[rows],
            self.xyz[rows],
            tuple(self.image[i] for i in rows),
            self.used_mask[rows],
            tuple(self.label[i] for i in rows),
        )

    def using(self, used: np.ndarray) -> LidarPairs:
        """The same pairs with others of them used (P,)."""
        return replace(self, used=used)


def joined(parts: Sequence[LidarPairs]) -> LidarPairs:
    """The pairs of several files or images, one below the other."""
    return LidarPairs(
        np.concatenate([part.pixel for part in parts]),
        np.concatenate([part.xyz for part in parts]),
        tuple(name for part in parts for name in part.image),
        np.concatenate([part.used_mask for part in parts]),
        tuple(name for part in parts for name in part.label),
    )


def _names(names: Sequence[str] | str, n: int) -> tuple[str, ...]:
    if isinstance(names, str):
        names = (names,)
    names = tuple(str(name) for name in names)
    return names * n if len(names) == 1 else names or ("",) * n


def _check(pairs: LidarPairs) -> None:
    """Raise InputError for pairs that cannot be meant."""
    n = len(pairs.pixel)
    shapes = {"pixel": (n, 2), "xyz": (n, 3), "used": (n,)}
    for key, shape in shapes.items():
        if getattr(pairs, key).shape != shape:
            found = f"shape {getattr(pairs, key).shape}"
            raise InputError(
                "The pairs do not fit together.", key=key, expected=f"shape {shape}", found=found
            )
    for key in ("image", "label"):
        if len(getattr(pairs, key)) != n:
            found = f"{len(getattr(pairs, key))} for {n} pairs"
            raise InputError("The pairs do not fit together.", key=key, expected="one a pair", found=found)
    wrong = ~np.isfinite(np.concatenate([pairs.pixel, pairs.xyz], axis=1)).all(axis=1)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(
            f"Pair {row + 1} has a number that is missing or not finite.",
            key=f"pair {row + 1}",
            expected="pixels u, v and metres x, y, z",
            found=" ".join(f"{v:g}" for v in (*pairs.pixel[row], *pairs.xyz[row])),
            remedy="complete the pair, or leave it out",
        )
    origin = ~pairs.xyz.any(axis=1)
    if origin.any():
        row = int(np.argmax(origin))
        raise InputError(
            f"Pair {row + 1} is at the lidar itself.",
            key=f"pair {row + 1}",
            expected="a return of the lidar, m",
            found="0 0 0, what a lidar writes where nothing came back",
            remedy="pick another point, or leave the pair out",
        )
    _check_twins(pairs)


def _check_twins(pairs: LidarPairs) -> None:
    first: dict[tuple, int] = {}
    for row, key in enumerate(zip(pairs.image, map(tuple, np.c_[pairs.pixel, pairs.xyz]), strict=True)):
        if key in first:
            raise InputError(
                f"Pair {row + 1} is pair {first[key] + 1} again: same image, pixel and point.",
                key=f"pair {row + 1}",
                expected="each pair once; a second pick of one place has its own numbers",
                remedy="leave one of them out; counting it twice would make the result look surer than it is",
            )
        first[key] = row


def read_lidar_pairs(path: Path | str) -> LidarPairs:
    """Read pairs of picks: CSV with the columns image,u,v,x,y,z and maybe use and label, or JSON.

    Raises
    ------
    InputError
        The file is missing or broken, a column is missing, or a number cannot be read.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError("The file of pairs does not exist.", file=path, remedy="check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            "The file of pairs cannot be read.",
            file=path,
            expected="CSV or JSON, as text (UTF-8)",
            found=str(error),
            remedy="check the path; a spreadsheet saves such a file as CSV UTF-8",
        ) from None
    rows = _json_rows(text, path) if text.lstrip()[:1] in ("{", "[") else _csv_rows(text, path)
    numbers = np.array([[_number(row, key, path) for key in _NUMBERS] for _, row in rows]).reshape(-1, 5)
    try:
        return LidarPairs(
            numbers[:, :2],
            numbers[:, 2:],
            tuple(row.get("image") or "" for _, row in rows),
            np.array([_used(row, path) for _, row in rows], dtype=bool),
            tuple(row.get("label") or "" for _, row in rows),
        )
    except InputError as error:
        raise InputError(
            error.problem, file=path, key=error.key, expected=error.expected, found=error.found,
            remedy=error.remedy,
        ) from None  # fmt: skip


def _csv_rows(text: str, path: Path) -> list[tuple[int, dict[str, Any]]]:
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    reader = csv.DictReader(io.StringIO("\n".join(lines)), skipinitialspace=True, restkey="_more")
    try:
        names = [str(name).strip().lower() for name in reader.fieldnames or ()]
        reader.fieldnames = names
        missing = [name for name in _NUMBERS if name not in names]
        if missing:
            near = did_you_mean(missing[0], [name for name in names if name not in COLUMNS])
            raise InputError(
                f"The file of pairs has no column '{missing[0]}'{near}.",
                file=path,
                key=missing[0],
                expected="the columns image,u,v,x,y,z, and maybe use and label",
                found=", ".join(names)[:200] or "nothing",
                remedy=_REMEDY,
            )
        rows = [
            (i, {k: v.strip() if isinstance(v, str) else v for k, v in row.items()})
            for i, row in enumerate(reader)
        ]
    except csv.Error as error:
        raise InputError("The file of pairs cannot be read.", file=path, found=str(error)) from None
    for i, row in rows:
        row["_place"] = f"pair {i + 1}"
        if "_more" in row:
            raise InputError(
                f"Pair {i + 1} has more values than there are columns.",
                file=path,
                key=row["_place"],
                remedy="put quotes around a label with a comma, and a point in decimal numbers",
            )
    return rows


def _json_rows(text: str, path: Path) -> list[tuple[int, dict[str, Any]]]:
    try:
        data = json.loads(text)
    except ValueError as error:
        raise InputError(
            "The file of pairs is no whole JSON.", file=path, found=str(error), remedy=_REMEDY
        ) from None
    if not isinstance(data, dict) or data.get("format") != FORMAT or not isinstance(data.get("pairs"), list):
        raise InputError(
            "This JSON holds no pairs of picks.",
            file=path,
            expected=f'{{"format": "{FORMAT}", "pairs": [{{"image", "u", "v", "x", "y", "z"}}, …]}}',
            found=", ".join(map(str, data))[:200] if isinstance(data, dict) else type(data).__name__,
            remedy="check the path; a calibration is another file than the pairs it was made from",
        )
    rows = []
    for i, row in enumerate(data["pairs"]):
        if not isinstance(row, dict):
            raise InputError(f"Pair {i + 1} is no object.", file=path, key=f"pairs.{i}", found=repr(row)[:80])
        rows.append((i, row | {"_place": f"pairs.{i}"}))
    return rows


def _number(row: dict[str, Any], key: str, path: Path) -> float:
    value = row.get(key)
    try:
        if isinstance(value, bool) or value is None or value == "":
            raise ValueError
        number = float(value)
        if not np.isfinite(number):
            raise ValueError
        return number
    except (TypeError, ValueError):
        place = row["_place"]
        raise InputError(
            f"'{key}' of {place} is no number.",
            file=path,
            key=f"{place}.{key}",
            expected="a number with a decimal point",
            found=repr(value) if value not in (None, "") else "nothing",
            remedy="complete the pair, or leave its row out",
        ) from None


def _used(row: dict[str, Any], path: Path) -> bool:
    value = row.get("use", row.get("used", True))
    if value is None:
        return True
    text = str(value).strip().lower()
    if text in _YES:
        return True
    if text in _NO:
        return False
    raise InputError(
        f"'use' of {row['_place']} is neither yes nor no.",
        file=path,
        key=f"{row['_place']}.use",
        expected="1 or 0, true or false",
        found=repr(value),
    )


def write_lidar_pairs(path: Path | str, pairs: LidarPairs) -> None:
    """Write pairs as CSV, or as JSON where the name ends so; whole or not at all, every digit kept."""
    path = Path(path)
    rows = [
        (image, *pixel, *xyz, int(used), label)
        for image, pixel, xyz, used, label in zip(
            pairs.image,
            pairs.pixel.tolist(),
            pairs.xyz.tolist(),
            pairs.used_mask.tolist(),
            pairs.label,
            strict=True,
        )
    ]
    if path.suffix.lower() == ".json":
        entries = [dict(zip(COLUMNS, row, strict=True)) for row in rows]
        for entry in entries:
            entry["use"] = bool(entry["use"])
        text = json.dumps({"format": FORMAT, "pairs": entries}, indent=1, ensure_ascii=False) + "\n"
    else:
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows([[repr(v) if isinstance(v, float) else v for v in row] for row in rows])
        text = stream.getvalue()
    write_text_whole(path, text)
