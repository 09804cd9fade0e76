"""What the calibration page says: hints, the step under way, the solution in words, the table."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.calibrate_page_work import ENOUGH, Work

HELP = (
    "Click a corner in the image, then the same corner in the cloud. 12 and more pairs, spread over the "
    "image and over distances, give a result to rely on.",
    "Image: wheel zooms, dragging moves, arrow keys move the pick under way by 0.25 px (with Shift 2 px).\n"
    "Cloud: dragging turns about the point under the cursor, Shift-drag (or the right button) moves, the "
    "wheel zooms; the sliders show a part of the ranges and intensities only.\n"
    "Both, under the cursor: + and − zoom, 0 shows everything.",
    "Ctrl-Z undoes, Ctrl-Y does again, Escape forgets the pick under way, Delete deletes the chosen pair; "
    "Page Up and Page Down change the image.",
    "A dropped pair stays in the list and in the file, and does not count. “Error” is the distance from the "
    "pick to where the calibration projects its point (green crosses in the image); “left out” is the same "
    "under the calibration from all other pairs: a pick that is wrong stands out there.",
    "Picks are on disk after every change, and the next session goes on with them.",
)
COLUMNS: list[dict[str, Any]] = [
    {"name": "number", "label": "#", "field": "number", "align": "right"},
    {"name": "image", "label": "image", "field": "image", "align": "left"},
    {"name": "pixel", "label": "image u, v (px)", "field": "pixel", "align": "right"},
    {"name": "xyz", "label": "cloud x, y, z (m)", "field": "xyz", "align": "right"},
    {"name": "range", "label": "range (m)", "field": "range", "align": "right"},
    {"name": "error", "label": "error (px)", "field": "error", "align": "right"},
    {"name": "left_out", "label": "left out (px)", "field": "left_out", "align": "right"},
    {"name": "actions", "label": "", "field": "number", "align": "left"},
]
ACTIONS = r"""
<q-tr :props="props" :class="{chosen: props.row.chosen, dropped: !props.row.used}"
  :data-pair="props.row.number" @click="$parent.$emit('choose', props.row.number)">
  <q-td v-for="column in props.cols" :key="column.name" :props="props"
    :class="{actions: column.name == 'actions', bad: column.name == 'error' && props.row.outlier}">
    <template v-if="column.name != 'actions'">{{ column.value }}<span
      v-if="column.name == 'error' && props.row.outlier"> outlier</span></template>
    <template v-else>
      <q-btn flat dense round size="sm" :icon="props.row.used ? 'visibility' : 'visibility_off'"
        :aria-label="(props.row.used ? 'Drop pair ' : 'Use pair ') + props.row.number"
        @click.stop="$parent.$emit('drop', props.row.number)">
        <q-tooltip>{{ props.row.used ? 'Drop: keep it, but do not count it' : 'Use it again' }}</q-tooltip>
      </q-btn>
      <q-btn flat dense round size="sm" icon="ads_click" :aria-label="'Pick again pair ' + props.row.number"
        @click.stop="$parent.$emit('again', props.row.number)"><q-tooltip>Pick it again</q-tooltip></q-btn>
      <q-btn flat dense round size="sm" icon="delete_outline" :aria-label="'Delete pair ' + props.row.number"
        @click.stop="$parent.$emit('remove', props.row.number)"><q-tooltip>Delete</q-tooltip></q-btn>
    </template>
  </q-td>
</q-tr>
"""


def step(work: Work, image: str) -> str:
    """What to do next."""
    book = work.book
    if book.redoing is not None:
        return (
            f"Pair {book.redoing} again: click its place in the image, in the cloud, or both. Escape ends it."
        )
    half, number = book.half(image), len(book.pairs) + 1
    if half is None:
        return f"Pair {number}: click a place in the image, or in the cloud"
    other = "cloud" if half.pixel is not None else "image"
    return f"Pair {number}: now click the same place in the {other} (Escape forgets it)"


def facts(work: Work) -> tuple[str, str, str]:
    """Headline, numbers and messages of the solution."""
    n, used = len(work.book.pairs), work.n_used
    solution = work.current
    if solution is None:
        if used < ENOUGH:
            more = ENOUGH - used
            return f"{used} pairs: {more} more until the first result", _dropped(n - used), ""
        return ("No result" if work.problem else "Solving …"), _dropped(n - used), ""
    camera, saved = solution.camera, solution.lidar_camera
    matrix = camera.matrix
    focal = f"focal length {solution.focal_px:.1f} px"
    sd = saved.sd("log_f")
    if np.isfinite(sd):
        focal += f" ± {sd * solution.focal_px:.1f}"
    outliers = int(np.sum(solution.outlier))
    lines = [
        f"left out {solution.left_out_rmse_px:.2f} px · median {solution.median_px:.2f} px · {used} pairs"
        + (f", {outliers} of them {'an outlier' if outliers == 1 else 'outliers'}" if outliers else "")
        + (f" · {n - used} dropped" if n > used else ""),
        f"{focal} · centre {matrix[0, 2]:.1f}, {matrix[1, 2]:.1f} px",
        "lidar to camera: {:.3f}, {:.3f}, {:.3f} m".format(*camera.translation)
        + (
            ""
            if np.isnan(saved.sd("translation_z"))
            else f" (± {saved.sd('translation_z'):.3f} along the axis)"
        ),
    ]
    headline = f"RMSE {solution.rmse_px:.2f} px" + (" · saved" if work.saved else "")
    return headline, "\n".join(lines), "\n".join(solution.messages)


def table_rows(work: Work, chosen: int | None) -> list[dict[str, Any]]:
    """Rows of the table, as text; the chosen one is marked."""
    return [
        row
        | {
            "range": f"{row['range']:.2f}",
            "error": _number(row["error"]),
            "left_out": _number(row["left_out"]),
            "chosen": row["number"] == chosen,
        }
        for row in work.rows()
    ]


def saved_text(written: object, work: Work) -> str:
    """What to say after saving."""
    if isinstance(written, str | Path):
        return f"Saved: {written}"
    if isinstance(written, Iterable):
        return "Saved: " + ", ".join(str(one) for one in written)
    return f"Saved beside {work.path}"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def _dropped(count: int) -> str:
    return f"{count} dropped" if count else ""
