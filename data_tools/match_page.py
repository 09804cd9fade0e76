"""The report of a matching: one HTML page with everything inside, that opens without a network.

Whatever comes from files (names, warnings) is escaped.
"""

from __future__ import annotations

import base64
import json
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acino_fte.data_tools.match_viewer import SCRIPT, VIEWER
from acino_fte.data_tools.plots_tracks import FIGURES
from acino_fte.data_tools.plots_tracks_style import colours_of
from acino_fte.report_page import PAGE, STYLE
from acino_fte.report_scene import ground_grid

if TYPE_CHECKING:
    from acino_fte.cameras import Camera
    from acino_fte.data_tools.match_points import SpacePoints
    from acino_fte.data_tools.track_matching import TrackMatches

_MOST = 80_000  # points in the viewer
_RIGHT = 0.99  # pairing accuracy from which the headline is green


def write_match_page(
    matches: TrackMatches, points: SpacePoints, metrics: dict[str, Any], folder: Path
) -> Path:
    """Write ``report.html`` into the folder of a matching, with the figures that are in its ``figures``.

    Parameters
    ----------
    matches : TrackMatches
        Of either method.
    points : SpacePoints
        Its points in space.
    metrics : dict
        What ``metrics.json`` holds.
    folder : Path
        An existing folder.

    Returns
    -------
    Path
        The page.
    """
    data = viewer_data(matches, points)
    sections = [_cards(metrics), _list(metrics["warnings"])]
    if len(points):
        sections.append("<h2>In space</h2>" + VIEWER.replace("@grid@", f"{data['grid']['step']:g}"))
    sections += [_figures(folder / "figures"), _tables(metrics)]
    fields = {
        "title": escape(f"{metrics['recording']}: animals matched over {metrics['n_cameras']} cameras"),
        "style": STYLE,
        "colour": _colour(metrics),
        "status": escape(_headline(metrics)),
        "advice": escape(_advice(metrics)),
        "body": "\n".join(section for section in sections if section),
        "data": _script_json(data),
        "script": SCRIPT,
    }
    parts = PAGE.split("@")
    page = "".join(fields.get(part, f"@{part}@") if i % 2 else part for i, part in enumerate(parts))
    path = folder / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def viewer_data(matches: TrackMatches, points: SpacePoints) -> dict[str, Any]:
    """What the viewer shows.

    Returns
    -------
    dict
        ``tracks`` (group, frames, xyz in m) of every piece of path, thinned when there are very many points;
        ``colours`` of the groups; ``cameras`` (name, aspect, pose: centre, right, down, forward);
        ``first`` and ``last`` frame; ``fps``; ``grid``, ``middle`` and ``size`` of the scene, m.
    """
    recording = matches.recording
    every = max(1, -(-len(points) // _MOST))
    tracks = []
    ends = np.flatnonzero(np.diff(points.piece) != 0) + 1 if len(points) else np.empty(0, dtype=int)
    for start, stop in zip(np.r_[0, ends], np.r_[ends, len(points)], strict=True):
        thin = np.unique(np.r_[np.arange(start, stop, every), max(stop - 1, start)])[: stop - start]
        if not len(thin):
            continue
        tracks.append(
            {
                "group": int(points.group[start]),
                "frames": points.frame[thin].tolist(),
                "xyz": np.round(points.position[thin], 4).tolist(),
            }
        )
    position = points.position if len(points) else np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]])
    low, high = np.quantile(position, [0.002, 0.998], axis=0)
    inside = position[((position >= low) & (position <= high)).all(1)]
    inside = inside if len(inside) else position
    return {
        "tracks": tracks,
        "colours": ["#" + "".join(f"{round(255 * v):02x}" for v in c) for c in colours_of(matches.n_groups)],
        "cameras": [_camera(camera) for camera in recording.cameras],
        "first": recording.first_frame,
        "last": recording.first_frame + max(recording.n_frames - 1, 0),
        "fps": recording.fps,
        "grid": ground_grid(inside[:, None]),
        "middle": np.round(0.5 * (low + high), 4).tolist(),
        "size": max(float(np.linalg.norm(high - low)), 1e-3),
    }


def _camera(camera: Camera) -> dict[str, Any]:
    """A camera where it is first."""
    rotation = camera.rotation.reshape(-1, 3, 3)[0]
    pose = np.concatenate([np.atleast_2d(camera.centre)[0], rotation.ravel()])
    width, height = camera.resolution
    return {"name": camera.name, "aspect": round(height / width, 4), "pose": np.round(pose, 5).tolist()}


def _headline(metrics: dict[str, Any]) -> str:
    return f"{metrics['n_animals']} animals matched" if metrics["n_animals"] else "Nothing was matched"


def _colour(metrics: dict[str, Any]) -> str:
    if not metrics["n_animals"]:
        return "red"
    right = (metrics["truth"] or {}).get("pairing_accuracy")
    return "green" if right is None or right >= _RIGHT else "amber"


def _advice(metrics: dict[str, Any]) -> str:
    if metrics["n_animals"]:
        return f"Method: {metrics['method']}."
    return (
        "Check that the camera file belongs to the tracks, and that the frames of all cameras have one clock."
    )


def _script_json(value: Any) -> str:
    """JSON that can stand in a script element: no ``<``, ``>`` or ``&`` as themselves."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _number(value: float | None, unit: str = "", digits: int = 2) -> str:
    return "–" if value is None else f"{value:.{digits}f} {unit}".strip()


def _share(value: float | None, digits: int = 1) -> str:
    return "–" if value is None else f"{value:.{digits}%}"


def _cards(metrics: dict[str, Any]) -> str:
    cameras = metrics["cameras"].values()
    rows, matched = sum(c["rows"] for c in cameras), sum(c["matched"] for c in cameras)
    begin, end = metrics["frames"]
    cards = [
        (str(metrics["n_animals"]), "animals"),
        (_share(matched / rows if rows else None), f"of {rows:,} dots matched"),
        (f"{end - begin:,}", f"frames of {metrics['n_cameras']} cameras"),
        (_number(metrics["noise_px"]["total"], "px"), "noise of a dot's coordinate"),
        (_number(metrics["reprojection_px"]["median"], "px"), "median reprojection error"),
        (_number(metrics["points_3d"]["median_sd_mm"], "mm", 1), "median sd of a position"),
        (_number(metrics["seconds"]["total"], "s", 1), "in all"),
    ]
    truth = metrics["truth"]
    if truth is not None:
        cards += [
            (_share(truth["pairing_accuracy"], 2), "pairing accuracy (truth)"),
            (_share(truth["recall"], 2), "recall (truth)"),
            (str(truth["identity_switches"]), "identity switches (truth)"),
        ]
        error = truth.get("position_mm", {}).get("right_pairs", {})
        if error.get("count"):
            cards.append((_number(error["mean"], "mm", 1), "mean distance to the truth"))
    items = "".join(f'<div class="card"><b>{escape(v)}</b><span>{escape(t)}</span></div>' for v, t in cards)
    return f'<div class="cards">{items}</div>'


def _list(warnings: list[str]) -> str:
    items = "".join(f"<li>{escape(text)}</li>" for text in warnings)
    return f'<ul class="warnings">{items}</ul>' if items else ""


def _figures(folder: Path) -> str:
    """The figures that are there, embedded; the PDF beside the page is linked."""
    shown = []
    for name, (caption, _) in FIGURES.items():
        path = folder / f"{name}.png"
        if path.is_file():
            image = base64.b64encode(path.read_bytes()).decode("ascii")
            shown.append(
                f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{image}">'
                f'<figcaption>{escape(caption)} (<a href="figures/{name}.pdf">PDF</a>)</figcaption></figure>'
            )
    return "<h2>Figures</h2>" + "\n".join(shown) if shown else ""


def _tables(metrics: dict[str, Any]) -> str:
    head = ("camera", "dots", "tracks", "matched", "share", "animals", "reprojection, median", "90 %")
    errors = metrics["reprojection_px"]["per_camera"]
    rows = [
        (
            name,
            f"{c['rows']:,}",
            f"{c['tracks']:,}",
            f"{c['matched']:,}",
            _share(c["matched_share"]),
            str(c["animals"]),
            _number(errors[name]["median"], "px"),
            _number(errors[name]["p90"], "px"),
        )
        for name, c in metrics["cameras"].items()
    ]
    seconds = [(name, _number(value, "s", 3)) for name, value in metrics["seconds"].items()]
    tables = _table(head, rows) + _table(("step", "time"), seconds)
    return f'<h2>Cameras and time</h2><div class="tables">{tables}</div>'


def _table(head: tuple[str, ...], rows: list[Any]) -> str:
    top = "".join(f"<th>{escape(text)}</th>" for text in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(v)}</td>" for v in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"
