"""Inertial samples from tables (CSV, TSV, text), whose columns and units the header or the user states."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.data_tools.recording import GRAVITY, ImuSamples
from acino_fte.data_tools.text_tables import column_numbers, read_text_table
from acino_fte.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

TIME_UNITS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
RATE_UNITS = {"rad/s": 1.0, "deg/s": np.pi / 180.0}
FORCE_UNITS = {"m/s2": 1.0, "g": GRAVITY, "mg": 1e-3 * GRAVITY}
_ALIKE = {"µs": "us", "μs": "us", "sec": "s", "m/s²": "m/s2", "m/s^2": "m/s2", "°/s": "deg/s", "dps": "deg/s"}
_WORDS = {"time": "time", "rate": "rate", "force": "specific force"}
_LONGEST_NS = 4e18  # of a stamp: 127 years
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
    table, comments = read_text_table(path, "inertial samples")
    bare = {name: _split(name) for name in table.columns}
    chosen = _columns(path, bare, columns or {})
    scale = {
        key: _unit(path, key, [bare[c][1] for c in chosen[key]], given, known)
        for key, given, known in (("rate", rate_unit, RATE_UNITS), ("force", force_unit, FORCE_UNITS))
    }
    values = {key: column_numbers(path, table, chosen[key]) * scale[key] for key in scale}
    if chosen["time"]:
        unit = _unit(path, "time", [bare[chosen["time"][0]][1]], time_unit, TIME_UNITS)
        time_ns = _whole_times(path, np.round(column_numbers(path, table, chosen["time"])[:, 0] * unit))
    else:
        time_ns = _even_times(path, table, comments, sample_rate)
    return ImuSamples(time_ns, values["rate"], values["force"])


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
            axes = [(m[2], name) for name, (text, _) in bare.items() if (m := _AXES[key].match(text))]
            out[key] = [name for _, name in sorted(axes)] if {axis for axis, _ in axes} == set("xyz") else []
        missing = [name for name in out[key] if name not in bare]
        few = key != "time" and len(out[key]) < 3
        if missing or few or len(out[key]) > 3:
            raise InputError(
                f"The table {'lacks' if missing or few else 'has too many'} columns of the {_WORDS[key]}.",
                file=path,
                key=key,
                expected=", ".join(missing) or f"three columns such as {key}_x, {key}_y, {key}_z",
                found=", ".join(bare if missing or few else out[key])[:200],
                remedy="name them so in the first line of the table, and other columns differently",
            )
    return out


def _unit(
    path: Path, key: str, stated: Sequence[str | None], given: str | None, known: Mapping[str, float]
) -> float:
    """Factor to SI; the unit given wins, else the header states it, the same one for all columns."""
    units = {given} if given else {unit for unit in stated if unit}
    units = {_ALIKE.get(unit, unit) for unit in units}
    if len(units) == 1 and (unit := units.pop()) in known:
        return known[unit]
    raise InputError(
        f"The unit of the {_WORDS[key]} is not known, and it is never guessed.",
        file=path,
        key=key,
        expected=" or ".join(known),
        found=given or ", ".join(str(unit) for unit in stated if unit) or "none in the header",
        remedy=f"state it (--{key}-unit)",
    )


def _whole_times(path: Path, time_ns: np.ndarray) -> np.ndarray:
    """Stamps (K,) as integers, ns."""
    bad = np.flatnonzero(~(np.abs(time_ns) < _LONGEST_NS))
    if len(bad):
        raise InputError(
            "A sample has no time that can be.",
            file=path,
            key=f"sample {int(bad[0])}",
            expected=f"a number, of at most {_LONGEST_NS * 1e-9:.0f} s",
            found=f"{time_ns[bad[0]] * 1e-9:g} s",
            remedy="check the unit of the times, and the line",
        )
    return time_ns.astype(np.int64)


def _even_times(path: Path, table: pd.DataFrame, comments: Sequence[str], hertz: float | None) -> np.ndarray:
    """Stamps (K,), ns, of a table without times, by the rate that is given or that a comment states."""
    for line in comments:
        match = re.search(r"sampl\w* *rate\D*([0-9]+(?:\.[0-9]*)?) *hz", line, re.IGNORECASE)
        if match and hertz is None:
            hertz = float(match[1])
    if hertz is None or not 0 < hertz < 1e9:
        raise InputError(
            "The table has no column of time, and no sample rate is known.",
            file=path,
            expected="a column 'time' with its unit, or a sample rate above 0",
            found=", ".join(map(str, table.columns))[:200],
            remedy="give the sample rate in Hz (--sample-rate)",
        )
    return np.round(np.arange(len(table)) * 1e9 / hertz).astype(np.int64)
