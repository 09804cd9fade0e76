from dataclasses import replace
from io import BytesIO

import matplotlib
import numpy as np
import pytest
from matplotlib.image import imread
from synthetic_result import make_result

from acino_fte.plots import FIGURES, save_figures
from acino_fte.plots_joints import joint_groups
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


def words(figure):
    return [t.get_text() for t in figure.findobj(matplotlib.text.Text) if t.get_text()]


def test_every_figure_as_png_and_pdf(result, tmp_path):
    before = dict(matplotlib.rcParams)
    written = save_figures(result, tmp_path / "figures")
    assert {p.name for p in written} == {f"{n}.{kind}" for n in FIGURES for kind in ("png", "pdf")}
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
def test_labels_have_units(result, name, labels):
    found = words(FIGURES[name][1](result))
    assert [label for label in labels if label not in found] == []


def test_the_error_figure_prints_the_metrics(result):
    text = "\n".join(words(FIGURES["reprojection_error"][1](result)))
    error = result.metrics["reprojection_px"]
    assert f"median {error['median']:.1f} px" in text
    assert f"RMSE {error['rmse']:.1f} px" in text
    assert f"{error['within_20px']:.1%} within 20 px" in text


@pytest.mark.parametrize("name", FIGURES)
def test_unconverged_is_marked(result, name):
    assert "NOT CONVERGED: interrupted" in words(FIGURES[name][1](replace(result, status=Status.INTERRUPTED)))
    assert not any("NOT CONVERGED" in w for w in words(FIGURES[name][1](result)))


@pytest.mark.parametrize("case", ["one frame", "nothing seen", "behind", "odd names"])
def test_unusual_results_are_drawn(result, case):
    if case == "one frame":
        result = make_result(n_frames=1, n_cameras=1)
    elif case == "nothing seen":
        result = replace(result, observed=np.full_like(result.observed, np.nan))
    elif case == "behind":
        result = replace(result, reprojected=np.full_like(result.reprojected, np.nan))
    else:
        result = replace(result, sequence=replace(result.sequence, name="$x_{1} & <b> \\alpha"))
    for _, draw in FIGURES.values():
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
