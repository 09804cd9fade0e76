"""Figures and page of a matching: what is drawn is what was matched, for three animals and for many."""

import json
import re
from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from matplotlib.collections import LineCollection, PatchCollection

from acino_fte.data_tools.colours import colours_of
from acino_fte.data_tools.match_numbers import match_metrics
from acino_fte.data_tools.match_page import viewer_data, write_match_page
from acino_fte.data_tools.match_points import SOURCE_NAMES, SpacePoints, space_points
from acino_fte.data_tools.plots_tracks import FIGURES, save_track_figures
from acino_fte.data_tools.plots_tracks_pairs import matrix_figure, residual_figure
from acino_fte.data_tools.plots_tracks_space import space_figure, track_lines
from acino_fte.data_tools.plots_tracks_style import runs
from acino_fte.data_tools.plots_tracks_time import timeline_figure
from acino_fte.data_tools.plots_tracks_views import overlay_figure
from acino_fte.data_tools.simulate_tracks import TrackSimulation, simulate_tracks
from acino_fte.data_tools.track_evidence import Noise
from acino_fte.data_tools.track_matching import TrackMatches, match_tracks


def true_matches(recording, noise=3.0):
    """The true animals as the matching, without paths."""
    offset, pieces = 0, []
    for view in recording.views:
        pieces.append(np.where(view.track >= 0, view.track + offset, -1))
        offset += len(view.labels)
    return TrackMatches(
        recording,
        tuple(np.asarray(view.animal).astype(np.int64) for view in recording.views),
        tuple(np.where(np.asarray(view.animal) >= 0, 0.9, np.nan) for view in recording.views),
        tuple(pieces),
        np.full(offset, -1),
        np.zeros(offset),
        Noise(noise),
    )


def simulated(**options):
    return simulate_tracks(TrackSimulation(**{"n_animals": 3, "n_frames": 60, "seed": 2, **options}))


@pytest.fixture(scope="module")
def matches():
    """Three animals in two cameras, in fragments, followed in 3D."""
    return match_tracks(simulated(tracks="fragments", missed=0.1, clutter=0.1))


@pytest.fixture(scope="module")
def points(matches):
    return space_points(matches)


@pytest.fixture(scope="module")
def many():
    """Forty animals in three cameras."""
    return true_matches(simulated(n_animals=40, rig="ring", n_cameras=3, n_frames=20))


def points_at(frame, group, source):
    """Points along x."""
    n = len(frame)
    frame, group = np.array(frame), np.array(group)
    gap = (np.diff(group, prepend=group[0]) != 0) | (np.diff(frame, prepend=frame[0]) > 1)
    position = np.stack([frame, 10.0 * group, np.zeros(n)], axis=1)
    source = np.array([SOURCE_NAMES.index(name) for name in source])
    zero = np.zeros((n, 3, 3))
    return SpacePoints(group, frame, np.cumsum(gap), position, zero, source, np.full(n, 2), np.zeros(n))


# --- files -------------------------------------------------------------------------------------------


def test_every_figure_is_png_and_vector_pdf(matches, points, tmp_path):
    with matplotlib.rc_context({"font.size": 40, "axes.facecolor": "black"}):
        written = save_track_figures(matches, points, tmp_path)
    assert {p.name for p in written} == {f"{name}.{kind}" for name in FIGURES for kind in ("png", "pdf")}
    for path in written:
        content = path.read_bytes()
        if path.suffix == ".png":
            assert content.startswith(b"\x89PNG")
            continue
        assert content.startswith(b"%PDF")
        assert b"/Subtype /Type3" not in content  # journals refuse it
        assert (b"/Subtype /Image" in content) == (path.stem == "match_matrix")


@pytest.mark.parametrize("draw", [entry[1] for entry in FIGURES.values()], ids=list(FIGURES))
@pytest.mark.parametrize("kind", ["many", "nothing", "no view", "no noise"])
def test_figures_of_unusual_matchings(many, draw, kind):
    if kind == "nothing":
        many = replace(many, groups=tuple(np.full_like(g, -1) for g in many.groups))
    elif kind == "no view":
        recording = many.recording
        views = (*recording.views[:2], recording.views[2].at_rows(np.empty(0, dtype=int)))
        many = true_matches(replace(recording, views=views))
    elif kind == "no noise":
        many = replace(many, noise=Noise(np.nan, np.nan))
    figure = draw(many, space_points(many))
    figure.canvas.draw()
    texts = " ".join(t.get_text() for t in figure.findobj(matplotlib.text.Text))
    assert ("no animal was matched" in texts) == (kind == "nothing" and draw is not overlay_figure)


# --- style -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 7, 8, 21, 22, 300])
def test_every_animal_has_its_own_colour(n):
    colours = colours_of(n)
    assert colours.shape == (n, 3)
    assert ((colours >= 0) & (colours <= 1)).all()
    assert len(np.unique(colours.round(6), axis=0)) >= min(n, 200)


def test_neighbours_in_number_are_apart_in_colour():
    colours = colours_of(100)
    assert np.linalg.norm(np.diff(colours, axis=0), axis=1).min() > 0.2


def test_runs():
    first, stop = runs(np.array([0, 0, 1, 0, 1], dtype=bool))
    assert (first.tolist(), stop.tolist()) == ([0, 2, 4], [2, 4, 5])
    assert [len(part) for part in runs(np.empty(0, dtype=bool))] == [0, 0]


# --- tracks in space ---------------------------------------------------------------------------------


def test_lines_are_solid_where_seen_dashed_where_filled_dotted_across_gaps():
    source = ["views", "single", "filled", "filled", "views", "views", "views", "views", "views", "views"]
    lines = track_lines(points_at([0, 1, 2, 3, 4, 5, 20, 21, 0, 1], [0] * 8 + [1] * 2, source))
    found = [(line[:, 0].tolist(), group, style) for line, group, style in lines]
    assert found == [
        ([0, 1], 0, "-"),
        ([1, 2, 3, 4], 0, "--"),
        ([4, 5], 0, "-"),
        ([5, 20], 0, ":"),
        ([20, 21], 0, "-"),
        ([0, 1], 1, "-"),
    ]


def test_many_points_are_thinned_along_their_paths():
    track = points_at(list(range(1000)) * 2, [0] * 1000 + [1] * 1000, ["views"] * 2000)
    lines = track_lines(track, most=200)
    assert [len(line) for line, _, _ in lines] == [101, 101]
    assert [line[-1, 0] for line, _, _ in lines] == [999, 999]


def test_projections_have_one_scale_and_hold_every_track(matches, points):
    figure = space_figure(matches, points)
    figure.canvas.draw()
    flat = [axes for axes in figure.axes if axes.get_xlabel()]
    assert {axes.get_xlabel()[0] + axes.get_ylabel()[0] for axes in flat} == {"xz", "yz", "xy"}
    for axes in flat:
        box = axes.get_window_extent()
        scale_x = box.width / np.ptp(axes.get_xlim())
        scale_y = box.height / np.ptp(axes.get_ylim())
        assert scale_x == pytest.approx(scale_y, rel=1e-6)
        for name, (low, high) in zip(
            (axes.get_xlabel()[0], axes.get_ylabel()[0]), (axes.get_xlim(), axes.get_ylim()), strict=True
        ):
            values = points.position[:, "xyz".index(name)]
            assert ((values >= low) & (values <= high)).mean() > 0.99
    scales = [axes.get_window_extent().width / np.ptp(axes.get_xlim()) for axes in flat]
    assert np.ptp(scales) < 1e-6 * scales[0]
    for axes in flat:
        drawn = [c for c in axes.collections if isinstance(c, LineCollection)]
        shades = {tuple(np.round(c[:3], 6)) for lines in drawn for c in lines.get_colors()}
        assert shades == {tuple(c) for c in colours_of(matches.n_groups).round(6)}


# --- views -------------------------------------------------------------------------------------------


def test_overlay_shows_every_dot_once(matches, points):
    figure = overlay_figure(matches, points)
    figure.canvas.draw()
    for axes, view, group in zip(figure.axes, matches.recording.views, matches.groups, strict=True):
        drawn = np.concatenate([line.get_xydata() for line in axes.lines])
        np.testing.assert_allclose(drawn[np.lexsort(drawn.T)], view.xy[np.lexsort(view.xy.T)])
        matched = sum(len(line.get_xydata()) for line in axes.lines if line.get_zorder() == 2)
        assert matched == (group >= 0).sum()
        assert axes.yaxis_inverted()
        assert axes.get_aspect() == 1.0


def test_timeline_has_a_bar_where_a_camera_sees_an_animal(matches, points):
    figure = timeline_figure(matches, points)
    (axes,) = figure.axes
    bars = [collection.get_segments() for collection in axes.collections]
    assert len(bars) == 3  # 3D paths, and two cameras
    for segments, view, group in zip(bars[1:], matches.recording.views, matches.groups, strict=True):
        for k in range(matches.n_groups):
            mine = [s for s in segments if abs(s[0, 1] - k) < 0.5]
            covered = np.concatenate([np.arange(s[0, 0] + 0.5, s[1, 0] + 0.5) for s in mine])
            assert set(view.frame[group == k]) <= set(covered)
            assert len(covered) <= (group == k).sum() + 2 * len(mine) + 0.3 * len(covered)


# --- pairs -------------------------------------------------------------------------------------------


def test_histogram_is_a_density_under_the_gaussian(matches, points):
    figure = residual_figure(matches, points)
    (axes,) = figure.axes
    (curve,) = [line for line in axes.lines if len(line.get_xdata()) > 100]
    assert np.trapezoid(curve.get_ydata(), curve.get_xdata()) == pytest.approx(1.0, abs=0.01)
    assert curve.get_ydata().max() == pytest.approx(1 / (matches.noise.total * np.sqrt(2 * np.pi)), rel=1e-3)
    outline = axes.patches[0].get_xy()
    area = 0.5 * abs(
        np.dot(outline[:, 0], np.roll(outline[:, 1], 1)) - np.dot(outline[:, 1], np.roll(outline[:, 0], 1))
    )
    assert area == pytest.approx(1.0, abs=0.05)


def test_matrix_is_dark_on_the_diagonal_only():
    matches = true_matches(simulated(n_animals=8, n_frames=100))
    figure = matrix_figure(matches, space_points(matches))
    axes = figure.axes[0]
    share = np.ma.filled(axes.images[0].get_array().astype(float), np.nan)
    assert share.shape == (8, 8)
    assert np.diag(share).min() > 0.95
    assert np.nanmax(share[~np.eye(8, dtype=bool)]) < 0.6
    (frames,) = [c for c in axes.collections if isinstance(c, PatchCollection)]
    assert len(frames.get_paths()) == 8


def test_matrix_of_very_many_pieces_is_one_of_animals(monkeypatch):
    monkeypatch.setattr("acino_fte.data_tools.plots_tracks_pairs._MOST_PIECES", 12)
    matches = true_matches(simulated(n_animals=5, n_frames=150, tracks="fragments"))
    axes = matrix_figure(matches, space_points(matches)).axes[0]
    assert axes.images[0].get_array().shape == (5, 5)
    assert "animal" in axes.get_xlabel()


# --- the page ----------------------------------------------------------------------------------------


def test_viewer_has_every_path(matches, points):
    data = viewer_data(matches, points)
    assert sum(len(track["frames"]) for track in data["tracks"]) == len(points)
    for track in data["tracks"]:
        place = points.find(np.full(len(track["frames"]), track["group"]), np.array(track["frames"]))
        np.testing.assert_allclose(track["xyz"], points.position[place], atol=6e-5)
    assert len(data["colours"]) == matches.n_groups
    assert all(re.fullmatch("#[0-9a-f]{6}", colour) for colour in data["colours"])
    assert [camera["name"] for camera in data["cameras"]] == matches.recording.cameras.names


def test_names_from_files_cannot_become_markup(matches, points, tmp_path):
    evil = "<script>alert(1)</script>@body@"
    named = replace(matches, recording=replace(matches.recording, name=evil, warnings=(evil,)))
    metrics = match_metrics(named, points, {"method": "tracks", "options": {}})
    (tmp_path / "figures").mkdir()
    for name in FIGURES:
        (tmp_path / "figures" / f"{name}.png").write_bytes(b"an image")
    page = write_match_page(named, points, {**metrics, "seconds": {"total": 1.0}}, tmp_path)
    page = page.read_text(encoding="utf-8")
    assert "<script>alert" not in page
    assert page.count("&lt;script&gt;alert(1)&lt;/script&gt;@body@") >= 2
    data = re.search(r'<script id="data" type="application/json">(.*?)</script>', page, re.DOTALL)
    assert json.loads(data[1])["tracks"]
    assert page.count("<figure>") == len(FIGURES)
