"""Inertial samples from tables (CSV, TSV, text), whose columns and units the header or the user states."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.data_tools.recording import GRAVITY, ImuSamples
from acino_fte.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

TIME_UNITS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
RATE_UNITS = {"rad/s": 1.0, "deg/s": np.pi / 180.0}
FORCE_UNITS = {"m/s2": 1.0, "g": GRAVITY, "mg": 1e-3 * GRAVITY}
_ALIKE = {"µs": "us", "μs": "us", "sec": "s", "m/s²": "m/s2", "m/s^2": "m/s2", "°/s": "deg/s", "dps": "deg/s"}
_TIME = re.compile(r"^(time|timestamp|stamp|t)([_ ].*)?$")
_AXES = {
    "rate": re.compile(r"^(gyr|gyro|gyroscope|omega|rate|angular[_ ]velocity|w)[_ .]*([xyz])$"),
    "force": re.compile(r"^(acc|accel|accelerometer|force|linear[_ ]acceleration|a)[_ .]*([xyz])$"),
}


def read_imu_table(
    path: Path | str,
    *,
    columns: Mapping[str, str | Sequence[str]] | None = None,
    time_unit: str | None = None,
    rate_unit: str | None = None,
    force_unit: str | None = None,
    sample_rate: float | None = None,
) -> ImuSamples:
    """Read samples of an inertial sensor from a table; lines from ``//`` or ``#`` are comments.

    Parameters
    ----------
    path : Path
        Columns apart by commas, semicolons, tabs or blanks.
    columns : dict, optional
        ``{"time": "Timestamp", "rate": ("gx", "gy", "gz"), "force": ("ax", "ay", "az")}``; what is not named
        is found by common names (Gyr_X, Gyroscope X, Acc_X, …).
    time_unit : {"s", "ms", "us", "ns"}, optional
        Of the time column.
    rate_unit : {"rad/s", "deg/s"}, optional
        Of the rates.
    force_unit : {"m/s2", "g", "mg"}, optional
        Of the specific force; a header such as ``Gyroscope X (deg/s)`` states its own. None is ever guessed.
    sample_rate : float, optional
        Hz, for a table without a time column; a comment ``Sample rate: 50.0Hz`` states it as well.

    Raises
    ------
    InputError
        The file cannot be read, a column is missing, or a unit is not stated.
    """
    path = Path(path)
    table, comments = _table(path)
    bare = {name: _split(name) for name in table.columns}
    chosen = _columns(path, bare, columns or {})
    scale = {
        key: _unit(path, key, [bare[c][1] for c in chosen[key]], given, known)
        for key, given, known in (("rate", rate_unit, RATE_UNITS), ("force", force_unit, FORCE_UNITS))
    }
    values = {key: _numbers(path, table, chosen[key]) * scale[key] for key in scale}
    if chosen["time"]:
        unit = _unit(path, "time", [bare[chosen["time"][0]][1]], time_unit, TIME_UNITS)
        time_ns = np.round(_numbers(path, table, chosen["time"])[:, 0] * unit)
        time_ns = _finite_times(path, time_ns)
    else:
        hertz = sample_rate or _stated_rate(comments)
        if not hertz:
            raise InputError(
                "The table has no column of time, and no sample rate is known.",
                file=path,
                expected="a column 'time' with its unit, or a sample rate",
                found=", ".join(map(str, table.columns))[:200],
                remedy="give the sample rate in Hz",
            )
        time_ns = np.round(np.arange(len(table)) * 1e9 / hertz).astype(np.int64)
    return ImuSamples(time_ns, values["rate"], values["force"])


def _table(path: Path) -> tuple[pd.DataFrame, list[str]]:
    import pandas as pd

    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            "The inertial samples cannot be read.", file=path, found=str(error), remedy="check the path"
        ) from None
    comments = [line for line in lines if line.startswith(("//", "#"))]
    rows = [line for line in lines if line.strip() and not line.startswith(("//", "#"))]
    header = rows[0] if rows else ""
    mark = next((m for m in (",", ";", "\t") if m in header), None)
    cells = [[c.strip() for c in (row.split(mark) if mark else row.split())] for row in rows]
    width = len([c for c in cells[0] if c]) if cells else 0
    if len(cells) < 2:
        raise InputError(
            "The table of inertial samples is empty.",
            file=path,
            expected="a line of names and a line for each sample",
            found=f"{len(cells)} line(s)",
        )
    body = [row[:width] + [""] * (width - len(row)) for row in cells[1:]]  # a last line may be cut
    return pd.DataFrame(body, columns=cells[0][:width]), comments


def _split(name: str) -> tuple[str, str | None]:
    """A column's name in small letters, and the unit in brackets behind it."""
    match = re.match(r"^(.*?)\s*[\[(]([^\])]*)[\])]\s*$", name)
    if not match:
        return name.strip().lower(), None
    unit = match[2].strip()
    return match[1].strip().lower(), _ALIKE.get(unit, unit)


def _columns(
    path: Path, bare: dict[str, tuple[str, str | None]], given: Mapping[str, str | Sequence[str]]
) -> dict[str, list[str]]:
    """Column names for time (one or none), rate and force (three each)."""
    out: dict[str, list[str]] = {}
    for key in ("time", "rate", "force"):
        if key in given:
            named = given[key]
            out[key] = [named] if isinstance(named, str) else list(named)
        elif key == "time":
            out[key] = [name for name, (text, _) in bare.items() if _TIME.match(text)][:1]
        else:
            axes = {m[2]: name for name, (text, _) in bare.items() if (m := _AXES[key].match(text))}
            out[key] = [axes[a] for a in "xyz" if a in axes]
        missing = [name for name in out[key] if name not in bare]
        if missing or (key != "time" and len(out[key]) != 3):
            raise InputError(
                f"The table lacks columns of the {'specific force' if key == 'force' else key}.",
                file=path,
                key=key,
                expected=", ".join(out[key])
                if missing
                else f"three columns such as {key}_x, {key}_y, {key}_z",
                found=", ".join(bare)[:200],
                remedy="name the columns",
            )
    return out


def _unit(
    path: Path, key: str, stated: Sequence[str | None], given: str | None, known: Mapping[str, float]
) -> float:
    """Factor to SI; the unit given wins, else the header states it."""
    found = given or next((unit for unit in stated if unit), None)
    found = _ALIKE.get(found, found) if found else None
    if found is not None and found in known:
        return known[found]
    what = "specific force" if key == "force" else key
    raise InputError(
        f"The unit of the {what} is not known, and it is never guessed.",
        file=path,
        key=key,
        expected=" or ".join(known),
        found=found or "none in the header",
        remedy=f"state it (--{key}-unit)",
    )


def _numbers(path: Path, table: pd.DataFrame, names: Sequence[str]) -> np.ndarray:
    """Columns (K, …) as numbers; empty cells are NaN."""
    import pandas as pd

    out = np.empty((len(table), len(names)))
    for i, name in enumerate(names):
        text = table[name]
        values = pd.to_numeric(text, errors="coerce")
        wrong = values.isna() & ~text.str.lower().isin(["", "nan", "na"])
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            if row != len(table) - 1:  # the last line of a cut file may end within a number
                raise InputError(
                    "The inertial samples hold something that is no number.",
                    file=path,
                    key=f"{name}, sample {row}",
                    found=repr(text.iloc[row]),
                )
        out[:, i] = values
    return out


def _finite_times(path: Path, time_ns: np.ndarray) -> np.ndarray:
    bad = np.flatnonzero(~np.isfinite(time_ns))
    if len(bad):
        raise InputError(
            "A sample has no time.",
            file=path,
            key=f"sample {int(bad[0])}",
            expected="a number",
            found="nothing",
        )
    return time_ns.astype(np.int64)


def _stated_rate(comments: Sequence[str]) -> float | None:
    for line in comments:
        match = re.search(r"sampl\w* *rate\D*([0-9.]+) *hz", line, re.IGNORECASE)
        if match:
            return float(match[1])
    return None
