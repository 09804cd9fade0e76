import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image
from synthetic_result import make_result, triangulated, with_estimates, with_evaluation

from acino_fte.plots import FIGURES
from acino_fte.report import _fill, headline_colour, number, share, write_report
from acino_fte.report_scene import ground_grid, marker_sides, scene
from acino_fte.result import Status

HOSTILE = "</script><script>alert(1)</script><b>&\"'"


@pytest.fixture(scope="module")
def result():
    return make_result(n_frames=8)


def page_of(result, folder):
    return write_report(result, folder).read_text(encoding="utf-8")


def data_of(page):
    return json.loads(re.search(r'<script id="data" type="application/json">(.*?)</script>', page, re.S)[1])


class Balance(HTMLParser):
    """Every element that opens, closes."""

    def __init__(self):
        super().__init__()
        self.open, self.faults, self.seen = [], [], []

    def handle_starttag(self, tag, attrs):
        self.seen.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "input", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.faults.append(tag)


def test_contains_the_numbers(result, tmp_path):
    page = page_of(result, tmp_path)
    error = result.metrics["reprojection_px"]
    assert number(error["median"], "px", 2) in page
    assert number(error["per_camera"]["cam2"]["p90"], "", 1) in page
    assert share(error["per_marker"]["spine"]["within_20px"]) in page
    assert number(result.metrics["truth_mm"]["mpjpe"], "mm", 2) in page
    assert "solve.max_iter" in page
    for name in [*result.sequence.cameras.names, *result.skeleton.marker_names]:
        assert f"<td>{name}</td>" in page


def test_is_well_formed_and_needs_no_network(result, tmp_path):
    (tmp_path / "figures").mkdir()
    for name in FIGURES:
        Image.new("RGB", (30, 20), "red").save(tmp_path / "figures" / f"{name}.png")
    page = page_of(result, tmp_path)
    parser = Balance()
    parser.feed(page)
    assert parser.faults == []
    assert parser.open == []
    assert "http" not in re.sub(r"http-equiv", "", page)
    images = [attrs["src"] for tag, attrs in parser.seen if tag == "img"]
    assert len(images) == len(FIGURES)
    assert all(src.startswith("data:image/png;base64,") for src in images)
    assert not any(attrs.get("src") for tag, attrs in parser.seen if tag in ("script", "link", "iframe"))
    assert len(page) < 3e6


def test_works_without_figures(result, tmp_path):
    page = page_of(result, tmp_path)
    assert "<figure>" not in page
    assert '<canvas id="scene"' in page


def test_everything_from_files_is_escaped(tmp_path):
    result = make_result(n_frames=3, warnings=(HOSTILE,))
    sequence = replace(result.sequence, name=HOSTILE)
    cameras = replace(
        sequence.cameras, cameras=(replace(sequence.cameras[0], name=HOSTILE), *sequence.cameras[1:])
    )
    detections = sequence.detections.assign_coords(camera=cameras.names)
    sequence = replace(sequence, cameras=cameras, detections=detections)
    page = page_of(replace(result, sequence=sequence, options={HOSTILE: HOSTILE}), tmp_path)
    assert "alert(1)</script>" not in page
    assert page.count("<script") == page.count("</script>") == 2
    assert "&lt;script&gt;alert(1)" in page
    assert data_of(page)["cameras"][0]["name"] == HOSTILE


def test_filling_does_not_look_at_what_was_filled_in():
    assert _fill("<p>@a@</p>@b@", {"a": "@b@", "b": "x"}) == "<p>@b@</p>x"


@pytest.mark.parametrize(
    ("status", "colour"),
    [
        (Status.CONVERGED, "green"),
        (Status.ACCEPTABLE, "amber"),
        (Status.MAX_ITERATIONS, "red"),
        (Status.MAX_TIME, "red"),
        (Status.INTERRUPTED, "red"),
        (Status.DIVERGED, "red"),
        (Status.FAILED, "red"),
    ],
)
def test_headline(result, tmp_path, status, colour):
    assert headline_colour(status) == colour
    page = page_of(replace(result, status=status), tmp_path)
    assert f'<header class="{colour}">' in page
    assert status.advice.split(";")[0] in page.replace("&#x27;", "'")
    assert ("Not converged" in page) == (not status.ok)


def test_warns_of_what_the_numbers_say(result, tmp_path):
    observed, reprojected = result.observed.copy(), result.reprojected.copy()
    observed[0] = np.nan
    observed[1, 0, 0], reprojected[1, 0, 0] = 5.0, np.nan
    q = result.q.copy()
    knee = result.skeleton.dof("l_back_calf.knee")
    q[:, knee] = result.skeleton.dofs[knee].lower
    page = page_of(replace(result, observed=observed, reprojected=reprojected, q=q), tmp_path)
    assert "1 observations are of markers that ended up behind" in page
    assert "1 frames have no observation at all" in page
    assert "l_back_calf.knee. Check their ranges" in page


def test_scene(result, tmp_path):
    data = data_of(page_of(result, tmp_path))
    assert data == scene(result)
    positions = np.array(data["positions"]).reshape(8, 24, 3) / 1000
    np.testing.assert_allclose(positions, result.positions, atol=6e-4)
    assert data["frames"] == list(range(80, 88))
    pose = np.array(data["cameras"][1]["poses"][0])
    np.testing.assert_allclose(pose[:3], result.sequence.cameras[1].centre, atol=1e-4)
    np.testing.assert_allclose(pose[3:].reshape(3, 3), result.sequence.cameras[1].rotation, atol=1e-4)
    sides = dict(zip(result.skeleton.marker_names, marker_sides(result), strict=True))
    assert (sides["l_hip"], sides["r_eye"], sides["spine"]) == ("left", "right", "middle")


def test_scene_of_moving_cameras_and_long_sequences(result):
    still = result.sequence.cameras[0]
    moving = replace(still, translation=still.translation + np.arange(8)[:, None] * np.array([0.1, 0, 0]))
    cameras = replace(result.sequence.cameras, cameras=(moving, *result.sequence.cameras[1:]))
    data = scene(replace(result, sequence=replace(result.sequence, cameras=cameras)))
    assert len(data["cameras"][0]["poses"]) == 8
    np.testing.assert_allclose(np.array(data["cameras"][0]["poses"])[:, :3], moving.centre, atol=1e-4)
    assert len(data["cameras"][1]["poses"]) == 1


def test_ground_grid_holds_the_animal():
    positions = np.array([[[0.0, -3.0, 0.02], [25.0, 2.0, 1.0]]])
    grid = ground_grid(positions)
    assert grid["x0"] < 0 < 25 < grid["x1"]
    assert grid["y0"] < -3 < 2 < grid["y1"]
    assert grid["z"] == 0.0
    assert grid["step"] == 2.0


def test_findings_parameters_and_uncertainty(result, tmp_path):
    estimated = with_estimates(result)
    findings = (*estimated.findings, HOSTILE)
    parameters = {**estimated.parameters, "mode": {"kind": HOSTILE}}
    page = page_of(replace(estimated, findings=findings, parameters=parameters), tmp_path)
    parser = Balance()
    parser.feed(page)
    assert parser.faults == parser.open == []
    assert page.index("cam2 is 5.4 ms behind") < page.index('id="viewer"')
    assert "alert(1)</script>" not in page
    for text in ("Time offset of the camera (ms), ± sd", "5.40 ± 0.40", "Rotation of the camera (°), ± sd"):
        assert text in page
    assert "−0.115 ± 0.029" in page
    sd_px = result.skeleton.markers[result.skeleton.marker("spine")].sd_px
    assert f"<td>spine</td><td>{estimated.parameters['noise_px']['spine']:.2f}</td><td>{sd_px:.2f}" in page
    found = estimated.metrics["uncertainty"]
    assert number(found["predicted_rmse_mm"], "mm", 2) in page
    assert share(found["ellipsoid_coverage_95"], 1) in page
    plain = page_of(result, tmp_path)
    assert "<h2>Uncertainty" not in plain and "<h2>Estimated parameters" not in plain


def test_cameras_left_out(result, tmp_path):
    evaluated = with_evaluation(result)
    page = page_of(evaluated, tmp_path)
    parser = Balance()
    parser.feed(page)
    assert parser.faults == parser.open == []
    assert "<b>12.2 px</b><span>median error in cameras left out, cross-fitted" in page
    assert "<b>70 %</b><span>within 20 px in cameras left out, nominal" in page
    first, second, _ = result.sequence.cameras.names
    dashes = "<td>–</td>" * 3 + "<td>0 %</td>"
    assert f"<td>{first}</td>{dashes}{dashes}<td>56</td>" in page
    assert f"<td>{second}</td><td>13.2</td><td>39.8</td><td>70 %</td><td>95 %</td><td>14.8</td>" in page
    assert "<td>all</td><td>12.2</td>" in page
    assert (
        "<td>+ camera poses</td><td>8.0</td><td>80.0 %</td><td>12.2</td><td>70.0 %</td><td>13.8</td>" in page
    )
    assert (
        page.index("<h2>Reprojection error") < page.index("<h2>Cameras left out") < page.index("<h2>The run")
    )


def test_cameras_left_out_without_a_ladder(result, tmp_path):
    evaluated = with_evaluation(result)
    del evaluated.evaluation["ladder"]
    page = page_of(evaluated, tmp_path)
    assert "<h2>Cameras left out" in page and "+ camera poses" not in page
    plain = page_of(result, tmp_path)
    assert "left out" not in plain


def test_page_of_a_method_without_a_skeleton(result, tmp_path):
    sparse = triangulated(result)
    data = data_of(page_of(sparse, tmp_path))
    positions = np.array(data["positions"], dtype=float).reshape(8, 24, 3) / 1000
    np.testing.assert_allclose(positions, sparse.positions, atol=6e-4)
    assert data["size"] == pytest.approx(scene(result)["size"], rel=0.3)
    nowhere = scene(replace(sparse, positions=np.full_like(sparse.positions, np.nan)))
    assert nowhere["size"] == 1.0
    assert nowhere["grid"]["x0"] < nowhere["grid"]["x1"]
