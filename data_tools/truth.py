"""True marker positions beside a recording: CSV with the columns frame, marker, x, y, z (m)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acino_fte.errors import InputError

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from acino_fte.skeleton import Skeleton

COLUMNS = ("frame", "marker", "x", "y", "z")


def read_truth(path: Path | str, skeleton: Skeleton, n_frames: int) -> xr.DataArray:
    """Read true positions.

    Returns
    -------
    xarray.DataArray
        (frame, marker, space = x, y, z), m, world frame; every frame of the recording, the markers of the
        species that the file has, NaN where it has no row.

    Raises
    ------
    InputError
        The file is missing or no such table, has no marker of the species or no frame of the recording, or
        gives a marker twice in a frame.
    """
    import pandas as pd
    import xarray as xr

    path = Path(path)
    table = _read_table(path)
    match = skeleton.match_keypoints(table["marker"].unique())
    known = table[table["marker"].isin(match.keys()) & table["frame"].between(0, n_frames - 1)]
    if known.empty:
        raise InputError(
            "The truth has no row for a marker of the species in a frame of the recording.",
            file=path,
            expected=f"frames 0 to {n_frames - 1}, markers of '{skeleton.name}'",
            found=f"frames {table['frame'].min():g} to {table['frame'].max():g}, markers "
            + ", ".join(map(str, table["marker"].unique()[:6])),
            remedy="leave 'truth' out, or number its frames from the start of the recording",
        )
    names = [m for m in skeleton.marker_names if m in set(match.values())]
    marker = known["marker"].map(match).map({m: i for i, m in enumerate(names)}).to_numpy()
    frame = known["frame"].to_numpy(dtype=np.int64)
    twice = pd.MultiIndex.from_arrays([frame, marker]).duplicated()
    if twice.any():
        first = int(np.argmax(twice))
        raise InputError(
            f"The truth gives marker '{names[marker[first]]}' twice in frame {frame[first]}.",
            file=path,
            expected="one row per frame and marker",
            remedy="remove one of the rows",
        )
    values = np.full((n_frames, len(names), 3), np.nan)
    values[frame, marker] = known[["x", "y", "z"]].to_numpy(dtype=float)
    return xr.DataArray(
        values,
        dims=("frame", "marker", "space"),
        coords={"frame": np.arange(n_frames), "marker": names, "space": ["x", "y", "z"]},
        attrs={"units": "m"},
    )


def _read_table(path: Path) -> pd.DataFrame:
    import pandas as pd

    expected = f"CSV with the columns {', '.join(COLUMNS)}"
    try:
        table = pd.read_csv(path, dtype={"marker": str, **dict.fromkeys("xyz", float), "frame": float})
    except FileNotFoundError:
        raise InputError("The truth file does not exist.", file=path, remedy="mend 'truth'") from None
    except (ValueError, OSError) as error:  # pandas' ParserError and EmptyDataError are ValueErrors
        raise InputError(
            "The truth file cannot be read.",
            file=path,
            expected=expected,
            found=str(error),
            remedy="mend it, or leave out 'truth'",
        ) from None
    if not set(COLUMNS) <= set(table.columns):
        raise InputError(
            "The truth file lacks a column.",
            file=path,
            expected=expected,
            found=", ".join(map(str, table.columns)),
            remedy="name the columns in its first line",
        )
    return table


def write_truth(path: Path | str, markers: list[str], position: np.ndarray, *, decimals: int = 5) -> None:
    """Write true positions (N, M, 3), m, one row per frame and marker; NaN rows are left out."""
    import pandas as pd

    n_frames, n_markers = position.shape[:2]
    table = pd.DataFrame(
        {
            "frame": np.repeat(np.arange(n_frames), n_markers),
            "marker": np.tile(np.asarray(markers, dtype=object), n_frames),
            **{axis: position[..., i].ravel().round(decimals) for i, axis in enumerate("xyz")},
        }
    )
    table.dropna().to_csv(path, index=False, lineterminator="\n", float_format=f"%.{decimals}f")
