"""How well two views agree: epipolar residuals of matched dots, and of all tracks with all others."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.collections import PatchCollection
from matplotlib.patches import Rectangle

from acino_fte.data_tools.match_points import SpacePoints, epipolar_residuals, matched_pairs, sampson_of_rows
from acino_fte.data_tools.plots_tracks_style import legend, new_track_figure
from acino_fte.plots_style import BLUE, GREY, ORANGE, RED, blank, margins

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from acino_fte.data_tools.track_matching import TrackMatches

_PANELS = 6
_SIGMAS = 6.0
_MAD = 1.4826
_WITHIN = 3.0  # standard deviations: what a right pair keeps to
_PAIRS = 400_000  # of dots looked at for the matrix
_LEAST_FRAMES, _LEAST_DOTS = 3, 10
_MOST_UNMATCHED = 200
_MOST_PIECES = 250  # with more, all pieces of an animal are one row
_MOST_ANIMALS = 150  # of more, some are shown


def residual_figure(matches: TrackMatches, points: SpacePoints) -> Figure:
    """Signed epipolar distance of matched dots, the noise's Gaussian over it, and what chance would give."""
    title = "Distance of matched dots from one epipolar plane"
    found = list(epipolar_residuals(matches))
    if not found:
        return blank(new_track_figure(matches, title, 7.0, 2.4), "no animal was matched")
    names = matches.recording.cameras.names
    panels: list[tuple[str, Any, Any]] = [
        (f"{names[a]}, {names[b]}", matched, chance) for a, b, matched, chance in found
    ]
    if len(panels) > _PANELS:
        matched, chance = (np.concatenate([panel[k] for panel in panels]) for k in (1, 2))
        panels = [(f"all {len(panels)} pairs of cameras", matched, chance)]
    columns = min(3, len(panels))
    rows = math.ceil(len(panels) / columns)
    width, height = (7.0 if columns == 1 else 1.0 + 3.3 * columns), 1.35 + 2.45 * rows
    figure = new_track_figure(matches, title, width, height, 1.0)
    margins(figure, 0.75, 0.2, 0.5, wspace=0.25, hspace=0.35)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for k, (axes, (name, matched, chance)) in enumerate(zip(grid, panels, strict=False)):
        _residual_panel(axes, matched, chance, matches.noise.total)
        axes.set_title(name, loc="left")
        if k % columns == 0:
            axes.set_ylabel("density (1/px)")
        if k + columns >= len(panels):
            axes.set_xlabel("signed Sampson distance (px)")
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    marks: list[tuple[str, dict[str, Any]]] = [
        ("matched dots", {"lw": 6, "alpha": 0.55, "color": BLUE}),
        ("Gaussian of the estimated noise", {"color": "black"}),
        ("by chance", {"color": ORANGE}),
    ]
    legend(figure, marks, 0.1, 0.56)
    return figure


def _residual_panel(axes: Axes, matched: np.ndarray, chance: np.ndarray, noise: float) -> None:
    matched, chance = matched[np.isfinite(matched)], chance[np.isfinite(chance)]
    seen = _MAD * float(np.median(np.abs(matched))) if len(matched) else 1.0
    sigma = noise if np.isfinite(noise) else seen
    reach = _SIGMAS * max(sigma, seen, 1e-6)
    bins = np.linspace(-reach, reach, int(np.clip(2 * math.sqrt(len(matched)), 21, 81)))
    width = bins[1] - bins[0]
    weights = np.full(len(matched), 1 / (max(len(matched), 1) * width))
    axes.hist(matched, bins.tolist(), weights=weights, color=BLUE, alpha=0.55, lw=0, histtype="stepfilled")
    if len(chance):
        counts, _ = np.histogram(chance, bins)
        axes.stairs(counts / (len(chance) * width), bins, color=ORANGE, lw=1.1)
    if np.isfinite(noise) and noise > 0:
        x = np.linspace(-reach, reach, 201)
        axes.plot(
            x, np.exp(-0.5 * (x / noise) ** 2) / (noise * math.sqrt(2 * math.pi)), color="black", lw=1.1
        )
    beyond = float((np.abs(matched) > reach).mean()) if len(matched) else 0.0
    text = f"{len(matched)} pairs\nscatter {seen:.3g} px"
    if np.isfinite(noise):
        text += f"\nnoise {noise:.3g} px"
    if beyond:
        text += f"\n{beyond:.1%} outside"
    axes.text(0.98, 0.97, text, transform=axes.transAxes, ha="right", va="top", fontsize=8, color=GREY)
    axes.set_xlim(-reach, reach)


def matrix_figure(matches: TrackMatches, points: SpacePoints) -> Figure:
    """Tracks of one camera against those of another, sorted by animal; framed where they are one animal.

    Of very many pieces of track, all those of an animal are one row.

    The colour is the share of their common frames in which they lie within three standard deviations of one
    epipolar plane: near 1 for one animal, less for two. Of more than two cameras, the pair with most matched
    dots is shown.
    """
    title = "How well the tracks of two cameras agree"
    sizes = {
        (a, b): len(matched_pairs(matches, a, b)[0])
        for a, b in combinations(range(len(matches.recording.views)), 2)
    }
    pair = max(sizes, key=lambda key: sizes[key], default=None)
    if pair is None or not sizes[pair]:
        return blank(new_track_figure(matches, title, 7.0, 2.4), "no animal was matched")
    units = [_units(matches, k) for k in pair]
    whole = max(map(len, units)) > _MOST_PIECES
    if whole:
        matches = replace(matches, pieces=tuple(np.where(g >= 0, g, -1) for g in matches.groups))
        units = [_some(_units(matches, k), matches.n_groups) for k in pair]
    share = _agreement(matches, pair, units)
    figure = new_track_figure(matches, title, 7.2, 7.0, 0.85)
    figure.text(
        0.1 / 7.2,
        1 - 0.53 / 7.0,
        "white: seldom near, or never together"
        + ("" if whole else "; red frame: one animal; sorted by animal, unmatched last"),
        va="top",
        fontsize=8.5,
        color=GREY,
    )
    margins(figure, 0.7, 0.95, 0.55)
    axes = figure.add_subplot()
    image = axes.imshow(
        share, cmap="Blues", vmin=0, vmax=1, interpolation="nearest", aspect="auto", origin="upper"
    )
    if not whole:
        _frames(axes, units, share)
    names = matches.recording.cameras.names
    kind = "animal, as seen" if whole else "piece of track"
    of = f"of {matches.n_groups}" if whole else "of them"
    axes.set_xlabel(f"{kind} in {names[pair[1]]}, {share.shape[1]} {of}")
    axes.set_ylabel(f"{kind} in {names[pair[0]]}, {share.shape[0]} {of}")
    for unit, axis in ((units[0], axes.yaxis), (units[1], axes.xaxis)):
        _ticks(axis, unit[:, 1])
    bar = figure.colorbar(image, ax=axes, fraction=0.045, pad=0.02)
    bar.set_label(f"share of common frames within {_WITHIN:g} standard deviations")
    bar.outline.set_visible(False)
    return figure


def _some(units: np.ndarray, n_groups: int) -> np.ndarray:
    """Of very many animals an even choice."""
    every = -(-n_groups // _MOST_ANIMALS)
    return units[(units[:, 1] >= 0) & (units[:, 1] % every == 0)]


def _units(matches: TrackMatches, k: int) -> np.ndarray:
    """(U, 2) piece and group in a view: matched pieces by group and first frame, then long others."""
    group, piece, frame = matches.groups[k], matches.pieces[k], matches.recording.views[k].frame
    use = np.flatnonzero(piece >= 0)
    keys, index, count = np.unique(
        np.stack([piece[use], group[use]], axis=1), axis=0, return_inverse=True, return_counts=True
    )
    first = np.full(len(keys), np.iinfo(np.int64).max)
    np.minimum.at(first, index.ravel(), frame[use])
    matched = keys[:, 1] >= 0
    lone = np.flatnonzero(~matched & (count >= _LEAST_DOTS))
    lone = lone[np.argsort(-count[lone], kind="stable")][:_MOST_UNMATCHED]
    mine = np.flatnonzero(matched)
    mine = mine[np.lexsort((first[mine], keys[mine, 1]))]
    return keys[np.r_[mine, lone[np.argsort(first[lone], kind="stable")]]]


def _agreement(matches: TrackMatches, pair: tuple[int, int], units: list[np.ndarray]) -> np.ndarray:
    """(U, W) share of the common frames in which pieces are near one plane; NaN where there are too few."""
    rows, unit = zip(*(_unit_of_rows(matches, k, u) for k, u in zip(pair, units, strict=True)), strict=True)
    frames = [matches.recording.views[k].frame[r] for k, r in zip(pair, rows, strict=True)]
    i, j = _together(frames[0], frames[1])
    noise = matches.noise.total
    if not np.isfinite(noise):
        a, b = matched_pairs(matches, *pair)
        noise = _MAD * float(np.nanmedian(np.abs(sampson_of_rows(matches, pair, a, b))))
    distance = np.abs(sampson_of_rows(matches, pair, rows[0][i], rows[1][j]))
    shape = len(units[0]), len(units[1])
    flat = unit[0][i] * shape[1] + unit[1][j]
    common = np.bincount(flat, minlength=shape[0] * shape[1])
    near = np.bincount(flat, weights=distance < _WITHIN * noise, minlength=shape[0] * shape[1])
    least = min(_LEAST_FRAMES, int(common.max(initial=1)))
    return np.where(common >= least, near / np.maximum(common, 1), np.nan).reshape(shape)


def _unit_of_rows(matches: TrackMatches, k: int, units: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a view that belong to one of the units, and which."""
    group, piece = matches.groups[k], matches.pieces[k]
    span = matches.n_groups + 2
    keys, wanted = piece * span + group + 1, units[:, 0] * span + units[:, 1] + 1
    order = np.argsort(wanted)
    place = np.minimum(np.searchsorted(wanted[order], keys), len(wanted) - 1)
    rows = np.flatnonzero(wanted[order][place] == keys)
    return rows, order[place[rows]]


def _together(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of entries with one frame; of very many frames every n-th."""
    frames, count_a = np.unique(a, return_counts=True)
    there, count_b = np.unique(b, return_counts=True)
    total = int(sum(count_a[np.isin(frames, there)] * count_b[np.isin(there, frames)]))
    every = max(1, -(-total // _PAIRS))
    rows_a, rows_b = np.flatnonzero(a % every == 0), np.flatnonzero(b % every == 0)
    order = rows_b[np.argsort(b[rows_b], kind="stable")]
    low = np.searchsorted(b[order], a[rows_a])
    count = np.searchsorted(b[order], a[rows_a], side="right") - low
    i = np.repeat(rows_a, count)
    return i, order[np.arange(count.sum()) + np.repeat(low - np.cumsum(count) + count, count)]


def _frames(axes: Axes, units: list[np.ndarray], share: np.ndarray) -> None:
    """A frame around the pieces of each animal, which lie together."""
    boxes = []
    for group in np.intersect1d(units[0][:, 1], units[1][:, 1]):
        if group < 0:
            continue
        y, x = (np.flatnonzero(unit[:, 1] == group) for unit in units)
        boxes.append(Rectangle((x[0] - 0.5, y[0] - 0.5), len(x), len(y)))
    width = float(np.clip(40.0 / max(share.shape), 0.2, 1.2))
    axes.add_collection(PatchCollection(boxes, facecolor="none", edgecolor=RED, lw=width))


def _ticks(axis, group: np.ndarray) -> None:
    """Numbers of the animals at the middle of their pieces, when there is room."""
    known = np.unique(group[group >= 0])
    places = np.array([np.flatnonzero(group == g).mean() for g in known])
    room, taken, kept = len(group) / 22, -np.inf, []
    for g, place in zip(known, places, strict=True):
        if place - taken >= room:
            kept.append((place, str(g)))
            taken = place
    axis.set_ticks([place for place, _ in kept], [name for _, name in kept], fontsize=7)
    axis.set_tick_params(length=0)
