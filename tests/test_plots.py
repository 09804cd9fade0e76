from dataclasses import replace
from functools import cache
from io import BytesIO

import matplotlib
import numpy as np
import pytest
from matplotlib.collections import EllipseCollection, PolyCollection
from matplotlib.image import imread
from synthetic_result import make_result, triangulated, with_estimates, with_evaluation

from acino_fte.plots import FIGURES, figures_of, save_figures
from acino_fte.plots_joints import joint_groups
from acino_fte.plots_positions import smooth_path
from acino_fte.plots_style import STYLE
from acino_fte.plots_trajectory import pose_frames, travel_frame, view
from acino_fte.plots_views import best_frame
from acino_fte.result import Status


@pytest.fixture(scope="module")
def result():
    return make_result(n_frames=20)


@pytest.fixture(autouse=True)
def style():
    with matplotlib.rc_context(STYLE):
        yield


@pytest.fixture(scope="module")
def small(lizard):
    """Of an animal of few joints, which has the same figures with fewer panels."""
    return make_result(n_frames=20, kinematics=lizard)


@pytest.fixture(scope="module")
def drawn(result):
    """The figure of a name for the result as it is, drawn once."""
    return cache(lambda name: FIGURES[name][1](result))


def words(figure):
    return [t.get_text() for t in figure.findobj(matplotlib.text.Text) if t.get_text()]


def test_every_figure_as_png_and_pdf(small, tmp_path):
    """(test_docs has those of a cheetah.)"""
    before = dict(matplotlib.rcParams)
    written = save_figures(small, tmp_path / "figures")
    assert {p.name for p in written} == {f"{n}.{kind}" for n in figures_of(small) for kind in ("png", "pdf")}
    assert dict(matplotlib.rcParams) == before
    for path in written:
        assert path.stat().st_size > 5000
        if path.suffix == ".png":
            image = imread(path)
            assert min(image.shape[:2]) > 400
            assert image[..., :3].std() > 0.03
        else:
            assert path.read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("name", "labels"),
    [
        ("reprojection_error", ["Reprojected − detected, u (px)", "Reprojection error (px)", "Observations"]),
        (
            "reprojection_by_camera",
            ["Reprojected − detected (px)", "Reprojection error (px)", "cam1\nobservations"],
        ),
        ("reprojection_by_marker", ["Reprojection error (px)", "spine", "r_back_paw"]),
        ("trajectory", ["Height (m)", "To the left (m)", "height (m)", "Time (s)"]),
        ("joint_angles", ["Angle (°)", "Time (s)", "back calf · knee"]),
        ("body_motion", ["Position (m)", "Speed (m/s)", "Time (s)", "Error (px)"]),
        ("camera_views", ["u (px)", "v (px)", "cam3"]),
    ],
)
def test_labels_have_units(drawn, name, labels):
    found = words(drawn(name))
    assert [label for label in labels if label not in found] == []


def test_the_error_figure_prints_the_metrics(result, drawn):
    text = "\n".join(words(drawn("reprojection_error")))
    error = result.metrics["reprojection_px"]
    assert f"median {error['median']:.1f} px" in text
    assert f"RMSE {error['rmse']:.1f} px" in text
    assert f"{error['within_20px']:.1%} within 20 px" in text


@pytest.mark.parametrize("name", FIGURES)
def test_unconverged_is_marked(result, drawn, name):
    assert "NOT CONVERGED: interrupted" in words(FIGURES[name][1](replace(result, status=Status.INTERRUPTED)))
    assert not any("NOT CONVERGED" in w for w in words(drawn(name)))


@pytest.mark.parametrize("case", ["one frame", "nothing seen", "behind", "odd names"])
def test_unusual_results_are_drawn(small, lizard, case):
    result = small
    if case == "one frame":
        result = make_result(n_frames=1, n_cameras=1, kinematics=lizard)
    elif case == "nothing seen":
        result = replace(result, observed=np.full_like(result.observed, np.nan))
    elif case == "behind":
        result = replace(result, reprojected=np.full_like(result.reprojected, np.nan))
    else:
        result = replace(result, sequence=replace(result.sequence, name="$x_{1} & <b> \\alpha"))
    for draw in (FIGURES[name][1] for name in figures_of(result)):
        image = BytesIO()
        draw(result).savefig(image, format="png", dpi=40)
        assert len(image.getvalue()) > 1000


def test_twins_share_a_panel(result):
    groups = joint_groups(result.skeleton)
    names = [[result.skeleton.dofs[j].name for j in group] for group in groups]
    assert ["l_front_calf.knee", "r_front_calf.knee"] in names
    assert ["neck.pitch"] in names
    turns = [j for j, dof in enumerate(result.skeleton.dofs) if dof.kind == "turn"]
    assert sorted(j for group in groups for j in group) == turns


def test_travel_frame_is_a_rigid_motion():
    rng = np.random.default_rng(1)
    body = rng.normal(0, 0.3, (5, 3))
    positions = body + np.arange(30)[:, None, None] * np.array([0.06, 0.08, 0.0])
    along, local = travel_frame(positions)
    np.testing.assert_allclose(along, [0.6, 0.8, 0.0], atol=1e-12)
    centre = local.mean(axis=1)
    np.testing.assert_allclose(centre[:, 0], 0.1 * np.arange(30), atol=1e-12)
    np.testing.assert_allclose(centre[:, 1], 0.0, atol=1e-12)
    distance = np.linalg.norm(positions[:, 0] - positions[:, 1], axis=-1)
    np.testing.assert_allclose(np.linalg.norm(local[:, 0] - local[:, 1], axis=-1), distance)


def test_view_is_a_parallel_projection():
    points = np.random.default_rng(2).normal(size=(4, 3))
    np.testing.assert_allclose(view(points[0] + points[1]), view(points[0]) + view(points[1]))
    matrix = view(np.eye(3)).T
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(2), atol=1e-12)


def test_pose_frames_have_both_ends():
    assert list(pose_frames(1)) == [0]
    assert list(pose_frames(3)) == [0, 1, 2]
    assert len(pose_frames(500)) == 14
    assert pose_frames(500)[-1] == 499


def test_best_frame_is_in_the_middle_third(result):
    observed = np.full_like(result.observed, np.nan)
    observed[0] = 1.0
    observed[9, 0, :3] = 1.0
    assert best_frame(replace(result, observed=observed)) == 9


def test_figures_follow_what_there_is(result):
    plain = set(figures_of(result))
    assert plain == set(FIGURES) - {"marker_positions", "uncertainty", "parameters", "depth", "ladder"}
    assert set(figures_of(with_estimates(result))) == set(FIGURES) - {"depth", "ladder"}
    assert set(figures_of(with_evaluation(result))) == plain | {"ladder"}
    assert set(figures_of(triangulated(result))) == plain - {"joint_angles"} | {"marker_positions"}


@pytest.mark.parametrize("case", ["estimated", "triangulated", "no position"])
def test_results_of_other_methods_are_drawn(small, case):
    result = small
    if case == "estimated":
        result = with_estimates(result)
        names = ["trajectory", "joint_angles", "body_motion", "marker_positions", "uncertainty", "parameters"]
    else:
        result = triangulated(result)
        names = ["trajectory", "joint_angles", "body_motion", "marker_positions", "reprojection_by_marker"]
    if case == "no position":
        nothing = np.full_like(result.positions, np.nan)
        result = replace(
            result,
            positions=nothing,
            reprojected=np.full_like(result.reprojected, np.nan),
            position_covariance=np.full((*nothing.shape, 3), np.nan),
        )
        names += ["uncertainty", "parameters", "reprojection_error", "camera_views"]
    for name in names:
        image = BytesIO()
        FIGURES[name][1](result).savefig(image, format="png", dpi=40)
        assert len(image.getvalue()) > 1000


def bands(figure, kind):
    return sum(isinstance(a, kind) for axes in figure.axes for a in axes.collections)


def test_bands_where_there_are_deviations(result, drawn):
    estimated = with_estimates(result)
    assert bands(drawn("joint_angles"), PolyCollection) == 0
    turns = sum(dof.kind == "turn" for dof in result.skeleton.dofs)
    assert bands(FIGURES["joint_angles"][1](estimated), PolyCollection) == turns
    assert bands(FIGURES["body_motion"][1](estimated), PolyCollection) == 3
    assert bands(FIGURES["marker_positions"][1](estimated), PolyCollection) == 3 * 24
    assert bands(FIGURES["trajectory"][1](estimated), EllipseCollection) == 2
    assert bands(drawn("trajectory"), EllipseCollection) == 0


def test_ellipses_have_two_standard_deviations(result):
    covariance = np.broadcast_to(np.diag([9e-4, 4e-4, 1e-4]), (*result.positions.shape, 3))
    straight = result.positions[:1] + np.arange(20)[:, None, None] * np.array([0.1, 0.0, 0.0])
    figure = FIGURES["trajectory"][1](replace(result, positions=straight, position_covariance=covariance))
    side, above = (c for axes in figure.axes for c in axes.collections if isinstance(c, EllipseCollection))
    np.testing.assert_allclose(side.get_widths(), 4 * 0.03)
    np.testing.assert_allclose(side.get_heights(), 4 * 0.01)
    np.testing.assert_allclose(above.get_heights(), 4 * 0.02)
    np.testing.assert_allclose(np.mod(above.get_angles() + 90, 180), 90, atol=1e-6)


def test_the_parameter_figure_shows_units_and_the_truth(result):
    estimated = with_estimates(result)
    plain = words(FIGURES["parameters"][1](estimated))
    labels = ("Offset (ms)", "Factor", "Angle (°)", "Shift (cm)", "Shift (mm)", "Noise (px)", "cam2", "neck")
    assert [label for label in labels if label not in plain] == []
    assert "× true" not in plain
    sequence = replace(estimated.sequence)
    object.__setattr__(sequence, "truth_parameters", {"time_offset_s": {"cam2": 0.005}})
    figure = FIGURES["parameters"][1](replace(estimated, sequence=sequence))
    assert "× true" in words(figure)
    (panel,) = (axes for axes in figure.axes if axes.get_xlabel() == "Offset (ms)")
    (cross,) = (line for line in panel.lines if line.get_marker() == "x")
    assert (cross.get_xdata()[0], cross.get_ydata()[0]) == (pytest.approx(5.0), 1)


def test_the_ladder_shows_every_rung(result, drawn):
    figure = FIGURES["ladder"][1](with_evaluation(result))
    median, near = figure.axes
    labels = [label.get_text() for label in median.get_xticklabels()]
    assert labels == ["nothing", "+ time\noffsets", "+ camera\nposes"]
    assert [list(line.get_ydata()) for line in median.lines] == [
        [11.3, 10.1, 8.0],
        [16.3, 14.6, 12.25],
        [15.8, 15.2, 13.75],
    ]
    assert {value for line in near.lines for value in line.get_ydata()} == {70.0, 80.0}
    assert (median.get_ylabel(), near.get_ylabel()) == ("Median error (px)", "Within 20 px (%)")
    for text in ("● cameras that took part", "◆ left out, cross-fitted", "■ left out, nominal"):
        assert text in words(figure)
    image = BytesIO()
    lost = with_evaluation(result)
    lost.evaluation["ladder"][1]["heldout_px"]["median"] = None
    FIGURES["ladder"][1](lost).savefig(image, format="png", dpi=40)
    assert len(image.getvalue()) > 1000
    assert any("no ladder was climbed" in word for word in words(drawn("ladder")))


def test_smooth_path_does_not_jump_when_markers_go(result):
    time = np.arange(20) / 120
    positions = np.arange(24)[:, None] * np.ones(3) * 0.01 + 5.0 * time[:, None, None]
    positions[:, 12:] = positions[:, 11:12]
    whole = smooth_path(time, positions)
    np.testing.assert_allclose(np.diff(whole, axis=0), 5.0 / 120, atol=1e-9)
    positions[10:, :3] = np.nan
    assert np.abs(np.diff(smooth_path(time, positions), axis=0) - 5.0 / 120).max() < 0.005
