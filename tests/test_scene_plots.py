"""Figures and page of a scene: what is drawn is what was triangulated, for one animal and for many."""

import base64
import json
import re
from dataclasses import replace
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from test_scene_files import NoFigures, nobody, scene_result

from acino_fte.data_tools.colours import colours_of, hex_colours
from acino_fte.data_tools.page_parts import script_json
from acino_fte.data_tools.scene_drawing import SceneDrawing, scene_drawing, thinned
from acino_fte.data_tools.scene_files import save_scene
from acino_fte.data_tools.scene_numbers import scene_metrics
from acino_fte.data_tools.scene_page import CAPTIONS, track_pieces, viewer_data, write_scene_page
from acino_fte.data_tools.scene_plots import (
    FIGURES,
    prepare,
    quality_figure,
    save_scene_figures,
    space_figure,
    track_lines,
)
from acino_fte.data_tools.scene_tracks import SOURCES

SINGLE, BETWEEN = SOURCES.index("single"), SOURCES.index("interpolated")


@pytest.fixture(scope="module")
def result():
    return scene_result(n_cameras=3)


@pytest.fixture(scope="module")
def drawing(result):
    return scene_drawing(result)


def texts(figure):
    found = [text.get_text() for text in figure.texts]
    for axes in figure.axes:
        found += [text.get_text() for text in axes.texts]
    return " ".join(found)


def tracks_drawn(axes):
    """Vertices of the lines that are tracks."""
    colours = [tuple(c) for c in colours_of(2)]
    return np.concatenate([line.get_xydata() for line in axes.lines if tuple(line.get_color()) in colours])


# --- what is drawn -----------------------------------------------------------------------------------


def test_a_drawing_survives_the_way_to_its_process(drawing):
    again = SceneDrawing.from_bytes(drawing.to_bytes())
    for name, value in vars(drawing).items():
        np.testing.assert_array_equal(getattr(again, name), value)
        assert type(getattr(again, name)) is type(value)


def test_a_drawing_has_only_what_is_known(drawing, result):
    assert len(drawing.pose_frame) == sum(path.known.sum() for path in result.paths)
    assert len(drawing.dot_error) == sum(u.sum() for u in result.tracks.used)
    assert np.isfinite(drawing.dot_error).all()
    assert set(drawing.dot_camera) == {0, 1}  # the third camera has no dots


def test_lines_join_only_neighbours_and_are_as_sure_as_their_worse_end(drawing):
    steps = {}
    for line, who, style in track_lines(drawing):
        for a, b in zip(line[:-1], line[1:], strict=True):
            steps[(who, tuple(a), tuple(b))] = style
    expected = {}
    for i in range(1, len(drawing.frame)):
        if (
            drawing.individual[i] == drawing.individual[i - 1]
            and drawing.frame[i] == drawing.frame[i - 1] + 1
        ):
            worse = max(drawing.source[i], drawing.source[i - 1])
            key = int(drawing.individual[i]), tuple(drawing.position[i - 1]), tuple(drawing.position[i])
            expected[key] = {SINGLE: "--", BETWEEN: ":"}.get(worse, "-")
    assert steps == expected
    assert set(expected.values()) == {"-", "--", ":"}


def test_both_panels_have_one_scale_and_show_everything(drawing):
    figure = space_figure(drawing)
    above, side = figure.axes
    scales = []
    for axes, pair in ((above, [0, 1]), (side, [0, 2])):
        box = axes.get_position().size * figure.get_size_inches()
        limits = np.array([axes.get_xlim(), axes.get_ylim()])
        scales += list(box / np.abs(np.diff(limits, axis=1)[:, 0]))
        points = np.concatenate([drawing.position, drawing.pose_centre])[:, pair]
        inside = (points >= limits.min(1)) & (points <= limits.max(1))
        assert inside.all()
        assert np.nanmax(tracks_drawn(axes)[:, 0]) == drawing.position[:, 0].max()
    np.testing.assert_allclose(scales, scales[0], rtol=1e-6)
    assert "x (m)" in texts(figure)


def test_every_step_is_drawn_in_its_style(drawing):
    lines = [line for line in space_figure(drawing).axes[0].lines if not isinstance(line.get_color(), str)]
    assert sorted({line.get_linestyle() for line in lines}) == ["-", "--", ":"]
    steps = {"-": 0, "--": 0, ":": 0}
    for line in lines:
        shown = np.isfinite(line.get_xydata()[:, 0])
        steps[line.get_linestyle()] += (shown[1:] & shown[:-1]).sum()
    found = {"-": 0, "--": 0, ":": 0}
    for line, _, style in track_lines(drawing):
        found[style] += len(line) - 1
    assert steps == found


def test_a_long_way_north_lies_across_the_page(drawing):
    turned = replace(
        drawing, position=drawing.position[:, [1, 0, 2]], pose_centre=drawing.pose_centre[:, [1, 0, 2]]
    )
    above = space_figure(turned).axes[0]
    assert "y (m)" in above.texts[0].get_text()
    right = above.get_xlim()[1] > above.get_xlim()[0]
    up = above.get_ylim()[1] > above.get_ylim()[0]
    assert right != up  # y to the right and x down: seen from above, not from below


def test_camera_paths_are_not_drawn_where_they_are_not_known(drawing):
    above = space_figure(drawing).axes[0]
    line = next(line for line in above.lines if line.get_color() == "#9A9A9A").get_xydata()
    assert np.isnan(line[:, 0]).sum() == 2 * len(drawing.cameras)  # one gap each, and its end
    np.testing.assert_allclose(line[np.isfinite(line[:, 0])], drawing.pose_centre[:, :2])


def test_the_band_has_the_views_of_every_frame(drawing):
    picture = np.asarray(quality_figure(drawing).axes[0].images[0].get_array().filled(-1))
    assert picture.shape == (2, 90)
    for who, frame, source, n in zip(
        drawing.individual, drawing.frame, drawing.source, drawing.n_views, strict=True
    ):
        assert picture[who, frame - 100] == (0 if source == BETWEEN else n)
    assert (picture[:, 50:55] == -1).all()


def test_uncertainty_is_in_millimetres_and_broken_at_gaps(drawing):
    lower = quality_figure(drawing).axes[1]
    assert len(lower.lines) == 2
    values = lower.lines[0].get_ydata()
    np.testing.assert_allclose(values[np.isfinite(values)], 10.0 * np.sqrt(3))
    assert np.isnan(values).sum() == 1
    assert "(mm)" in lower.texts[1].get_text()


def test_histograms_are_shares_of_each_camera(drawing):
    beside = quality_figure(drawing).axes[2]
    assert len(beside.patches) == 2
    for k, patch in enumerate(beside.patches):
        count, edges, _ = patch.get_data()
        mine = drawing.dot_error[drawing.dot_camera == k]
        np.testing.assert_allclose(count, np.histogram(mine, edges)[0] / len(mine))


def test_many_animals_and_cameras():
    many = scene_drawing(scene_result(n_frames=80, n_cameras=9, n_individuals=12))
    figure = quality_figure(many)
    _, lower, beside = figure.axes
    assert lower.collections and len(lower.lines) == 1  # a range and a median
    assert len(beside.patches) == 1  # all cameras together
    assert space_figure(many)


def test_nothing_to_draw_says_why(result, tmp_path):
    empty = scene_drawing(nobody(result))
    assert "no point was triangulated" in texts(space_figure(empty))
    assert "no point was triangulated" in texts(quality_figure(empty))
    silent = replace(scene_drawing(result), dot_error=np.empty(0), dot_camera=np.empty(0, dtype=int))
    assert "no dot counts" in texts(quality_figure(silent))


def test_without_cloud_scale_and_frame_rate(drawing):
    bare = replace(drawing, cloud=np.empty((0, 3)), unit="units", fps=np.nan, noise_px=np.nan)
    assert "x (units)" in texts(space_figure(bare))
    assert "(units)" in texts(quality_figure(bare))
    assert "nan" not in texts(space_figure(bare))


def test_figures_are_files_whatever_the_user_s_style(drawing, tmp_path):
    with matplotlib.rc_context({"axes.facecolor": "black", "figure.dpi": 30, "text.usetex": True}):
        files = save_scene_figures(drawing, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(p.name for p in files)
    assert set(FIGURES) == set(CAPTIONS)
    for path in files:
        assert path.read_bytes()[:4] == (b"%PDF" if path.suffix == ".pdf" else b"\x89PNG")


@pytest.mark.parametrize(("name", "n_fonts"), [("Zoë", 1), ("Ωmega", 2)])
def test_a_light_font_is_embedded_and_lends_letters_from_the_whole_one(tmp_path, name, n_fonts):
    result = scene_result(n_frames=70, names=("Ann", name))
    files = save_scene_figures(scene_drawing(result), tmp_path / "figures", prepare(tmp_path))
    embedded = next(p for p in files if p.suffix == ".pdf").read_bytes()
    assert embedded.count(b"/FontFile2") == n_fonts  # TrueType


@pytest.mark.parametrize("n", [0, 1, 7, 21, 22, 60])
def test_every_individual_has_a_colour_of_its_own(n):
    colours = colours_of(n)
    assert colours.shape == (n, 3)
    assert len(np.unique(np.round(255 * colours), axis=0)) == n
    assert ((colours >= 0) & (colours <= 1)).all()
    assert hex_colours(n)[:2] == ["#0072b2", "#e69f00"][:n] or n > 21


def test_thinning_keeps_both_ends():
    rows = np.arange(1000)
    few = thinned(rows, 7)
    assert len(few) == 7 and few[0] == 0 and few[-1] == 999
    assert thinned(rows, 1000) is rows


# --- the page ----------------------------------------------------------------------------------------


def unpacked(value):
    """Packed arrays of a page, as the viewer reads them."""
    if isinstance(value, dict) and "packed" in value:
        return np.frombuffer(base64.b64decode(value["packed"]), dtype="<" + value["type"])
    if isinstance(value, dict):
        return {key: unpacked(item) for key, item in value.items()}
    return [unpacked(item) for item in value] if isinstance(value, list) else value


def data_of(page):
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', page, re.DOTALL)
    return unpacked(json.loads(found[1]))


def test_pieces_have_every_point_and_meet(result):
    tracks, seen = result.tracks, set()
    for piece in track_pieces(tracks):
        assert (np.diff(piece["frames"]) == 1).all()
        for frame, point in zip(piece["frames"], piece["xyz"], strict=True):
            row = np.flatnonzero((tracks.individual == piece["group"]) & (tracks.frame == frame))
            np.testing.assert_array_equal(tracks.position[row[0]], point)
            seen.add(int(row[0]))
    assert seen == set(range(len(tracks)))
    styles = [(piece["group"], piece["style"]) for piece in track_pieces(tracks)]
    assert styles[:7] == [(0, "-"), (0, "--"), (0, "-"), (0, "-"), (0, ":"), (0, "-"), (1, "-")]


def test_pieces_can_be_thinned(result):
    pieces = track_pieces(result.tracks, most=20)
    assert sum(len(piece["frames"]) for piece in pieces) < 60
    assert pieces[0]["frames"][0] == 100


def test_the_viewer_has_cameras_where_they_are(result):
    data = viewer_data(result)
    assert [camera["name"] for camera in data["cameras"]] == ["cam 0", "cam 1", "cam 2"]
    for camera, path in zip(data["cameras"], result.paths, strict=True):
        np.testing.assert_array_equal(camera["frames"], path.frame[path.known])
        np.testing.assert_allclose(camera["pose"][:, :3], path.centre[path.known])
        np.testing.assert_allclose(camera["pose"][:, 9:], path.rotation[path.known][:, 2])  # forward
    assert data["first"] == 100 and data["last"] == 189


def test_a_camera_that_stands_still_has_one_pose(result):
    path = result.paths[0]
    still = replace(
        path,
        rotation=np.broadcast_to(path.rotation[:1], path.rotation.shape),
        translation=np.broadcast_to(path.translation[:1], path.translation.shape),
    )
    fixed = SimpleNamespace(**{**vars(result), "paths": (still, *result.paths[1:])})
    assert len(viewer_data(fixed)["cameras"][0]["frames"]) == 1


def test_the_page_holds_what_the_viewer_shows(result, tmp_path, monkeypatch):
    save_scene(result, tmp_path / "out", figures=NoFigures())
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    data, shown = data_of(page), viewer_data(result)
    assert data["names"] == ["bird 0", "bird 1"]
    for found, piece in zip(data["tracks"], shown["tracks"], strict=True):
        np.testing.assert_array_equal(found["frames"], piece["frames"])
        np.testing.assert_allclose(found["xyz"].reshape(-1, 3), piece["xyz"], atol=1e-5)
    np.testing.assert_array_equal(data["cloud"]["rgb"].reshape(-1, 3), result.scene.cloud.rgb)
    assert "http" not in page.replace("http-equiv", "")
    assert "@" not in page.split("<script")[0].split("</style>")[1]
    assert 'class="green"' in page
    monkeypatch.setitem(result.numbers["axes"], "tilt_sd_deg", None)  # what is up was guessed
    save_scene(result, tmp_path / "guess", figures=NoFigures())
    assert 'class="amber"' in (tmp_path / "guess" / "report.html").read_text(encoding="utf-8")


def test_names_from_files_cannot_become_markup(tmp_path):
    evil = "<script>alert(1)</script>@body@"
    result = scene_result(names=(evil, "b"))
    result.scene.name, result.scene.warnings = evil, (evil,)
    metrics = {**scene_metrics(result), "seconds": {"total": 1.0}}
    (tmp_path / "figures").mkdir()
    for name in FIGURES:
        (tmp_path / "figures" / f"{name}.png").write_bytes(b"an image")
    page = write_scene_page(result, metrics, tmp_path).read_text(encoding="utf-8")
    assert "<script>alert" not in page
    assert page.count("&lt;script&gt;alert(1)&lt;/script&gt;@body@") >= 3
    assert data_of(page)["names"][0] == evil
    assert page.count("<figure>") == len(FIGURES)


def test_what_has_no_place_in_a_page_is_refused():
    with pytest.raises(TypeError, match="object"):
        script_json({"a": object()})
    with pytest.raises(TypeError):
        script_json({"a": np.array(["text"])})
