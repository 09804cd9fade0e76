"""Report of calibrations to a lidar: errors by distance as tables (CSV, Markdown, LaTeX) and figures.

A row of the table is a calibration at one distance; pairs are at one distance where no gap of a quarter parts
them. Signed errors are projection minus pick.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.result_files import Contents, check_output_folder, written_whole

if TYPE_CHECKING:
    from acino_fte.data_tools.lidar_solve import Calibration

REPORT = Contents(
    "calibration report",
    ("errors.csv", "errors.md", "errors.tex", "pairs.csv", "calibrations.json", "figures"),
    ("errors.csv", "calibrations.json"),
)
_GAP = 1.25
COLUMNS = (
    ("distance_m", "Distance (m)", 1),
    ("n", "Pairs", 0),
    ("n_outliers", "Outliers", 0),
    ("focal_px", "f (px)", 0),
    ("rmse_u", "RMSE u (px)", 2),
    ("rmse_v", "RMSE v (px)", 2),
    ("rmse", "RMSE (px)", 2),
    ("sd_u", "SD u (px)", 2),
    ("sd_v", "SD v (px)", 2),
    ("sd", "SD abs. (px)", 2),
    ("left_out_rmse", "RMSE left out (px)", 2),
)
"""Columns of the tables for reading: key, title, digits."""
_NOTES = (
    "Signed u, v: projection minus pick. Absolute: distance in the image; its RMSE holds u and v together.",
    "Outliers are left out. Left out: each pair under the calibration from the others.",
)


def write_calibration_report(
    folder: Path | str,
    calibrations: Mapping[str, Calibration],
    images: Mapping[str, Path] | None = None,
    clouds: Mapping[str, np.ndarray] | None = None,
) -> list[Path]:
    """Write the report of calibrations, whole or not at all.

    Parameters
    ----------
    folder : Path
        Absent, empty, or an earlier report, which is replaced.
    calibrations : mapping of str to Calibration
        By name of the recording.
    images : mapping of str to Path, optional
        Picture files by name, as the pairs name their images: residuals are drawn over them.
    clouds : mapping of str to (K, 3), optional
        Point cloud of each image, m, in the lidar's frame: drawn over the image, coloured by depth.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    InputError
        The folder holds something else, or an image cannot be read.
    """
    from acino_fte.data_tools.lidar_figure import save_figures

    target = check_output_folder(folder, contents=REPORT)
    rows = [row for name, each in calibrations.items() for row in error_rows(name, each)]
    with written_whole(target, REPORT) as working:
        (working / "errors.csv").write_text(as_csv(rows), encoding="utf-8")
        (working / "errors.md").write_text(as_markdown(rows, calibrations), encoding="utf-8")
        (working / "errors.tex").write_text(as_latex(rows), encoding="utf-8")
        (working / "pairs.csv").write_text(_pairs_csv(calibrations), encoding="utf-8")
        summary = {name: _summary(each) for name, each in calibrations.items()}
        text = json.dumps(summary, indent=1, ensure_ascii=False)
        (working / "calibrations.json").write_text(text + "\n", encoding="utf-8")
        save_figures(calibrations, working / "figures", images or {}, clouds or {})
        names = sorted(path.relative_to(working) for path in working.rglob("*") if path.is_file())
    return [target / name for name in names]


def distance_groups(distance: np.ndarray) -> list[np.ndarray]:
    """Rows of the pairs at each distance, from near to far: a gap of a quarter parts two groups."""
    order = np.argsort(distance, kind="stable")
    ratio = distance[order][1:] / np.maximum(distance[order][:-1], 1e-9)
    return [np.sort(rows) for rows in np.split(order, np.flatnonzero(ratio > _GAP) + 1) if len(rows)]


def error_rows(name: str, calibration: Calibration) -> list[dict[str, Any]]:
    """Statistics of a calibration at each of its distances, and of all where there are several."""
    used = np.flatnonzero(calibration.pairs.used_mask)
    distance = calibration.pairs.distance
    groups = [used[rows] for rows in distance_groups(distance[used])]
    out = [_statistics(name, calibration, rows) for rows in groups]
    if len(groups) > 1:
        out.append(_statistics(name, calibration, used, "all"))
    return out


def _statistics(name: str, calibration: Calibration, rows: np.ndarray, which: str = "") -> dict[str, Any]:
    counted = rows[calibration.counted[rows]]
    error, left = calibration.residual[counted], calibration.left_out[counted]
    length = np.linalg.norm(error, axis=1)
    distance = calibration.pairs.distance[rows]
    sd_f = calibration.lidar_camera.sd("log_f") * calibration.focal_px
    out: dict[str, Any] = {
        "recording": name,
        "distance": which or f"{distance.mean():.1f} m",
        "distance_m": float(distance.mean()),
        "n": len(counted),
        "n_outliers": int(len(rows) - len(counted)),
        "focal_px": calibration.focal_px,
        "focal_sd_px": None if np.isnan(sd_f) else float(sd_f),
    }
    out |= {f"mean_{axis}": _of(np.mean, error[:, i]) for i, axis in enumerate("uv")}
    out |= {f"rmse_{axis}": _of(_rms, error[:, i]) for i, axis in enumerate("uv")}
    out |= {"rmse": _of(_rms, length), "mean": _of(np.mean, length), "median": _of(np.median, length)}
    out |= {f"sd_{axis}": _of(np.std, error[:, i]) for i, axis in enumerate("uv")}
    out |= {"sd": _of(np.std, length), "left_out_rmse": _of(_rms, np.linalg.norm(left, axis=1))}
    return out


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _of(statistic: Any, values: np.ndarray) -> float | None:
    return float(statistic(values)) if len(values) else None


def as_csv(rows: list[dict[str, Any]]) -> str:
    """All numbers, in full; empty where there are none."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]) if rows else ["recording"], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _cells(row: dict[str, Any]) -> list[str]:
    values = [row[key] for key, _, _ in COLUMNS]
    shown = [
        "–" if v is None else f"{v:.{digits}f}" for v, (_, _, digits) in zip(values, COLUMNS, strict=True)
    ]
    if row["distance"] == "all":
        shown[0] = "all"
    return shown


def as_markdown(rows: list[dict[str, Any]], calibrations: Mapping[str, Calibration]) -> str:
    """The table, notes, and what each calibration has to say."""
    heads = ["Recording", *(title for _, title, _ in COLUMNS)]
    lines = ["# Calibration of camera and lidar", "", f"| {' | '.join(heads)} |"]
    lines.append("|---|" + "--:|" * len(COLUMNS))
    lines += [f"| {' | '.join([_plain(row['recording']), *_cells(row)])} |" for row in rows]
    lines += ["", *_NOTES]
    for name, each in calibrations.items():
        lines += [f"\n**{_plain(name)}**: {message}" for message in each.messages]
    return "\n".join(lines) + "\n"


def _plain(text: str) -> str:
    return "".join(f"\\{c}" if c in "|<>*_`" else c for c in text.replace("\n", " "))


_TEX = {"\\": r"\textbackslash{}", **{c: f"\\{c}" for c in "&%$#_{}"}, "–": "--", "~": r"\textasciitilde{}"}
_TEX |= {"^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}", "\n": " "}


def _tex(text: str) -> str:
    return "".join(_TEX.get(c, c) for c in text)


def as_latex(rows: list[dict[str, Any]]) -> str:
    r"""One ``tabular`` for ``\input``; it needs the package booktabs."""
    heads = " & ".join(["Recording", *(_tex(title) for _, title, _ in COLUMNS)])
    lines = [r"% Calibration of camera and lidar. Needs \usepackage{booktabs}.", *(f"% {n}" for n in _NOTES)]
    lines += [rf"\begin{{tabular}}{{l{'r' * len(COLUMNS)}}}", r"\toprule", rf"{heads} \\", r"\midrule"]
    lines += [rf"{' & '.join(_tex(cell) for cell in [row['recording'], *_cells(row)])} \\" for row in rows]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def _pairs_csv(calibrations: Mapping[str, Calibration]) -> str:
    """Every pair with its residual."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    heads = ["recording", "image", "label", "u", "v", "x", "y", "z", "distance_m", "used", "outlier"]
    writer.writerow([*heads, "error_u", "error_v", "error", "left_out_u", "left_out_v"])
    for name, each in calibrations.items():
        pairs = each.pairs
        for i in range(len(pairs)):
            about = [name, pairs.image[i], pairs.label[i], *pairs.pixel[i], *pairs.xyz[i], pairs.distance[i]]
            flags = [int(pairs.used_mask[i]), int(each.outlier[i])]
            errors = [*each.residual[i], each.error_px[i], *each.left_out[i]]
            writer.writerow([*about, *flags, *("" if np.isnan(v) else v for v in errors)])
    return text.getvalue()


def _summary(calibration: Calibration) -> dict[str, Any]:
    """A calibration in numbers that JSON holds."""
    saved, camera = calibration.lidar_camera, calibration.camera
    sd = {name: saved.sd(name) for name in saved.parameters}
    bound = np.sqrt(np.diag(calibration.bound)).tolist()
    return {
        "resolution": list(camera.resolution),
        "camera_matrix": camera.matrix.tolist(),
        "distortion": camera.distortion.tolist(),
        "lidar_to_camera": saved.lidar_to_camera.tolist(),
        "fitted": list(calibration.fitted),
        "sd": sd,
        "cramer_rao_sd": dict(zip(saved.parameters, bound, strict=True)),
        "n_pairs": int(calibration.counted.sum()),
        "n_outliers": int(calibration.outlier.sum()),
        "rmse_px": calibration.rmse_px,
        "left_out_rmse_px": calibration.left_out_rmse_px,
        "noise_scale": calibration.scale,
        "determined": calibration.determined,
        "converged": calibration.converged,
        "messages": list(calibration.messages),
        "date": saved.date,
    }
