"""Runs read back, labels by hand, statistics against closed forms, tables that LaTeX and others read."""

import json
import re
import shutil

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from data_tools_synthetic import cloud, message
from evaluation_made import CORRECTION, START, STOP, edited, make_run, with_depth

from acino_fte.data_tools.deeplabcut import write_deeplabcut_csv
from acino_fte.evaluation_figures import depth_histograms, error_histograms, error_markers
from acino_fte.evaluation_labels import label_pixels, labels_of_runs, read_labels
from acino_fte.evaluation_runs import open_run, open_runs
from acino_fte.evaluation_statistics import Threshold, depth_rows, error_rows, errors_of
from acino_fte.evaluation_tables import as_csv, error_table, latex, markdown
from acino_fte.result import Status

PARAMETERS = {"time_offset_s": {"cam2": 0.004, "cam3": -0.002}, "extrinsics": {"cam3": CORRECTION}}
ODD = "run_1 & 50%"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run with late cameras and corrected poses, and one that did not converge with an odd name."""
    folder = tmp_path_factory.mktemp("evaluation")
    make_run(folder, "run", parameters=PARAMETERS)
    make_run(folder, ODD, seed=5, status=Status.MAX_ITERATIONS)
    return folder


@pytest.fixture(scope="module")
def run(folder):
    return open_run(folder / "run")


@pytest.fixture
def copied(folder, tmp_path):
    """A run of one's own, to be damaged."""
    shutil.copytree(folder / "recording", tmp_path / "recording")
    shutil.copytree(folder / "run", tmp_path / "run")
    return tmp_path / "run"


# --- runs ----------------------------------------------------------------------------------------------


def test_a_run_is_seen_through_its_own_cameras(run):
    """Late cameras, corrected poses: reprojections are those that the run wrote."""
    assert (run.frames[0], run.frames[-1] + 1, run.sequence) == (START, STOP, "cheetahs")
    np.testing.assert_allclose(run.positions, cloud()[START:STOP])
    seen = np.isfinite(run.detection)
    assert seen.mean() > 0.5
    again = run.reprojected()
    np.testing.assert_allclose((again - run.detection)[seen], run.residual[seen], atol=1e-9)
    plain = run.cameras["cam1"].project(run.positions)
    np.testing.assert_allclose(again[:, 0], plain)


def test_moving_cameras_are_cut_to_the_frames_of_the_run(tmp_path):
    run = open_run(make_run(tmp_path, moving=True, parameters=PARAMETERS))
    assert run.cameras["cam1"].moves and len(run.cameras["cam1"].translation) == STOP - START
    seen = np.isfinite(run.detection)
    np.testing.assert_allclose((run.reprojected() - run.detection)[seen], run.residual[seen], atol=1e-9)


def test_another_camera_file_is_noticed(copied):
    path = copied.parent / "recording" / "cameras.json"
    text = (copied / "sequence.yaml").read_text(encoding="utf-8")
    (copied / "sequence.yaml").write_text(
        text.replace(str(json_of(text, "cameras")), str(path)), encoding="utf-8"
    )
    open_run(copied).reprojected()  # an equal file will do
    cameras = json.loads(path.read_text(encoding="utf-8"))["cameras"]
    cameras[1]["translation"][0] += 0.02
    edited(path, cameras=cameras)
    error = message(lambda: open_run(copied).cameras)
    assert "not the one" in str(error) and "px apart" in str(error)
    edited(path, cameras=cameras[:2])
    assert "a camera 'cam3'" in str(message(lambda: open_run(copied).cameras))


def json_of(text, key):
    import yaml

    return yaml.safe_load(text)[key]


def _cut(run):
    data = (run / "fte.nc").read_bytes()
    (run / "fte.nc").write_bytes(data[: len(data) // 2])


def _other(run):
    xr.Dataset({"position": ("x", [1.0])}).to_netcdf(run / "fte.nc", engine="h5netcdf")


@pytest.mark.parametrize(
    "damage, words",
    [
        (lambda run: (run / "fte.nc").unlink(), "unfinished"),
        (lambda run: (run / "metrics.json").unlink(), "unfinished"),
        (lambda run: [p.unlink() for p in run.iterdir()], "no run"),
        (_cut, "cannot be read"),
        (_other, "no trajectory"),
        (lambda run: (run / "metrics.json").write_text("[1]"), "not the metrics"),
        (lambda run: (run / "metrics.json").write_text("{"), "cannot be read"),
        (lambda run: shutil.rmtree(run), "does not exist"),
    ],
)
def test_what_is_no_run_is_told(copied, damage, words):
    damage(copied)
    assert words in str(message(open_run, copied))


def test_runs_of_one_name_are_told_apart(folder, tmp_path):
    shutil.copytree(folder / "run", tmp_path / "run")
    names = [run.name for run in open_runs([folder / "run", tmp_path / "run"])]
    assert names == [f"{folder.name}/run", f"{tmp_path.name}/run"]
    assert "twice" in str(message(open_runs, [folder / "run", folder / "." / "run"]))


# --- labels --------------------------------------------------------------------------------------------

FRAMES, NAMES = (12, 15, 20), ("nose", "spine", "r_hip")


def labels(run):
    """(3, 3, 2) px of cam2: reprojections moved by (3, −4)."""
    at = [run.markers.index(name) for name in NAMES]
    return run.reprojected()[np.array(FRAMES) - START][:, 1][:, at] - [3.0, -4.0]


def write_collected(path, pixels, images):
    """As DeepLabCut writes hand labels: no likelihood, images instead of frames."""
    rows = [
        ["scorer"] + ["me"] * 6,
        ["bodyparts", *(n for n in NAMES for _ in "xy")],
        ["coords", *("xy" * len(NAMES))],
    ]
    rows += [[image, *(f"{v:.9f}" for v in p.ravel())] for image, p in zip(images, pixels, strict=True)]
    path.write_text("\n".join(",".join(row) for row in rows) + "\n", encoding="utf-8")
    return path


def write_plain(path, pixels):
    rows = [
        f"{f},{n},{u:.9f},{v:.9f}"
        for f, row in zip(FRAMES, pixels, strict=True)
        for n, (u, v) in zip(NAMES, row, strict=True)
    ]
    path.write_text("frame,marker,u,v\n" + "\n".join(rows) + "\n99,nose,1,1\n12,wing,1,1\n", encoding="utf-8")
    return path


def test_three_kinds_of_labels_say_the_same(run, tmp_path):
    pixels = labels(run)
    whole = np.full((FRAMES[-1] + 1, 3, 2), np.nan)
    whole[list(FRAMES)] = pixels
    write_deeplabcut_csv(tmp_path / "dlc.csv", NAMES, whole, np.ones(whole.shape[:2]), decimals=9)
    files = [
        write_collected(tmp_path / "c.csv", pixels, [f"labeled-data/cam2/img{f:05d}.png" for f in FRAMES]),
        write_collected(tmp_path / "d.csv", pixels, [f"v1/frame_{f}.jpg" for f in FRAMES]),
        write_plain(tmp_path / "plain.csv", pixels),
        tmp_path / "dlc.csv",
    ]
    for file in files:
        read, notes = label_pixels(run, {"cam2": file})
        there = np.isfinite(read).all(-1)
        assert there.sum() == 9 and there[:, 1].sum() == 9
        at = np.array(FRAMES) - START, [run.markers.index(name) for name in NAMES]
        np.testing.assert_allclose(read[:, 1][np.ix_(*at)], pixels, atol=1e-6)
        expected = ["1 labels outside", "not markers of the run: wing"] if file.name == "plain.csv" else []
        assert len(notes) == len(expected)
        assert all(words in note for words, note in zip(expected, notes, strict=True))


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "no table"),
        ("a,b\n1,2\n", "no table"),
        ("frame;marker;u;v\n1;nose;2;3\n", "commas"),
        ("frame,marker,u,v\n", "no labels"),
        ("frame,marker,u,v\n1,nose,x,3\n", "no number"),
        ("frame,marker,u,v\n1.5,nose,2,3\n", "no frame"),
        ("scorer,a,a\nbodyparts,nose,nose\ncoords,x,y\nimage.png,1,2\n", "names no frame"),
        ("scorer,a,a\nbodyparts,nose,nose\ncoords,a,b\nimg1.png,1,2\n", "no columns x, y"),
        ("scorer,a,a\nimg1.png,1,2\n", "lacks header rows"),
        ("frame,marker,u,v\n99,nose,2,3\n", "of a frame of the run"),
        ("frame,marker,u,v\n12,wing,2,3\n", "no marker of species"),
    ],
)
def test_what_is_no_table_of_labels_is_told(run, tmp_path, text, words):
    path = tmp_path / "l.csv"
    path.write_text(text, encoding="utf-8")
    assert words in str(message(label_pixels, run, {"cam1": path}))
    message(read_labels, tmp_path / "absent.csv")


def test_labels_find_their_runs(folder, run, tmp_path):
    runs = open_runs([folder / "run", folder / ODD])
    for name in ("cam1", "cam2"):
        (tmp_path / f"{name}.csv").write_text("x", encoding="utf-8")
    both = {"cam1": tmp_path / "cam1.csv", "cam2": tmp_path / "cam2.csv"}
    one = {"cam1": tmp_path / "cam1.csv"}
    assert labels_of_runs([str(tmp_path)], runs) == {"run": both, ODD: both}  # of one recording
    assert labels_of_runs([f"{ODD}:cam1={tmp_path / 'cam1.csv'}"], runs) == {ODD: one}
    assert labels_of_runs([f"run:{tmp_path}"], runs) == {"run": both}
    (tmp_path / "all" / "run").mkdir(parents=True)
    shutil.copy(tmp_path / "cam1.csv", tmp_path / "all" / "run")
    inside = {"cam1": tmp_path / "all" / "run" / "cam1.csv"}
    assert labels_of_runs([str(tmp_path / "all")], runs) == {"run": inside}
    for text, words in (
        ("cam7=x.csv", "no camera 'cam7'"),
        ("rum:cam1=x.csv", "did you mean 'run'"),
        (str(tmp_path / "absent"), "do not exist"),
        (str(folder), "no labels for a camera"),
    ):
        assert words in str(message(labels_of_runs, [text], runs)), text
    runs[1].metrics["sequence"] = "another"
    assert "not clear" in str(message(labels_of_runs, ["cam1=x.csv"], runs))


# --- statistics ----------------------------------------------------------------------------------------


def test_labels_a_known_step_away(run, tmp_path):
    """Residuals are (3, −4) px everywhere: mean and RMSE 5, sd 0, all beyond 4.9 and none beyond 5.1."""
    pixels, _ = label_pixels(run, {"cam2": write_plain(tmp_path / "l.csv", labels(run))})
    errors = errors_of(run, pixels)
    row = error_rows(errors, Threshold(4.9))[0]
    assert (row["of"], row["n"], row["n_behind"]) == ("labels", 9, 0)
    for key, value in {
        "mean_u": 3,
        "mean_v": -4,
        "sd_u": 0,
        "sd_v": 0,
        "mean": 5,
        "sd": 0,
        "rmse": 5,
    }.items():
        assert row[key] == pytest.approx(value, abs=1e-6), key
    assert row["outlier_ratio"] == 1.0
    assert error_rows(errors, Threshold(5.1))[0]["outlier_ratio"] == 0.0


def test_every_row_against_its_formula(run):
    """Without labels the run's own detections count; parts and markers add up to the run."""
    errors = errors_of(run, None)
    rows = error_rows(errors, Threshold(1.5))
    r = run.residual[np.isfinite(run.residual).all(-1)]
    e = np.hypot(*r.T)
    whole = rows[0]
    assert whole["n"] == len(e) and whole["of"] == "detections"
    assert whole["rmse"] == pytest.approx(np.sqrt(np.mean(e**2)))
    assert whole["rmse"] ** 2 == pytest.approx(whole["mean"] ** 2 + whole["sd"] ** 2)
    assert whole["sd_u"] == pytest.approx(r[:, 0].std())
    assert whole["outlier_ratio"] == pytest.approx(np.mean(e > 1.5))
    for level in ("part", "marker"):
        some = [row for row in rows if row["level"] == level]
        assert sum(row["n"] for row in some) == len(e)
        square = sum(row["n"] * row["rmse"] ** 2 for row in some if row["n"])
        assert square == pytest.approx(len(e) * whole["rmse"] ** 2)
    unseen = next(row for row in rows if row["name"] == run.markers[3])
    assert unseen["n"] == 0 and unseen["rmse"] is None and unseen["outlier_ratio"] is None


def test_a_threshold_in_standard_deviations_is_the_markers_own(run):
    sd = np.array([m.sd_px for m in run.skeleton.markers])
    threshold = Threshold(0.4, "sd")
    np.testing.assert_allclose(threshold.pixels(run), 0.4 * sd)
    errors = errors_of(run, None)
    known = ~np.isnan(errors.length)
    expected = (errors.length > 0.4 * sd)[known].mean()
    assert error_rows(errors, threshold)[0]["outlier_ratio"] == pytest.approx(expected)
    for value in (0.0, -1.0, np.nan):
        message(Threshold, value)


def test_a_label_of_a_marker_behind_the_camera_is_an_outlier(run, tmp_path):
    """Behind a pinhole there is no pixel: it counts as an outlier, and in no mean."""
    from dataclasses import replace

    behind = run.positions.copy()
    camera = run.cameras["cam1"]  # which is not late
    behind[2, 0] = camera.centre - 3.0 * camera.rotation[2]
    moved = replace(run, positions=behind)
    moved.__dict__["cameras"] = run.cameras
    pixels = np.full((len(run.frames), 3, len(run.markers), 2), np.nan)
    pixels[2, 0, 0] = 100.0
    pixels[3, 0, 0] = run.reprojected()[3, 0, 0]
    row = error_rows(errors_of(moved, pixels), Threshold(20.0))[0]
    assert (row["n"], row["n_behind"], row["outlier_ratio"]) == (2, 1, 0.5)
    assert row["rmse"] == pytest.approx(0, abs=1e-6)


def test_depth_of_a_run_with_a_lidar(copied):
    values = np.full((STOP - START, 24), np.nan)
    values[0, :4] = [0.03, -0.01, 0.02, 0.04]
    run = open_run(with_depth(copied, values))
    rows = {row["name"]: row for row in depth_rows(run)}
    row = rows["all"]
    assert row["n"] == 4 and row["mean"] == pytest.approx(0.02) and row["median"] == pytest.approx(0.025)
    assert row["rmse"] == pytest.approx(np.sqrt(0.003 / 4))
    assert rows["nose"]["n"] == 1 and rows["nose"]["mean"] == pytest.approx(0.03)
    assert rows["r_hip"]["n"] == 0 and rows["r_hip"]["rmse"] is None
    (axes,) = depth_histograms([run], [run]).axes
    assert "n 4" in axes.texts[0].get_text()
    for text in ("frame,marker\n10,nose\n", "frame,marker,measured,predicted\n9,nose,1,2\n"):
        (copied / "depth.csv").write_text(text, encoding="utf-8")
        assert "depths of the run" in str(message(open_run, copied))


def test_depth_of_a_run_that_wrote_only_metrics(copied):
    assert not open_run(copied).has_depth
    edited(copied / "metrics.json", depth_m={"n": 9, "bias": 0.01, "std": 0.02, "rmse": 0.0224, "p90": 0.03})
    run = open_run(copied)
    (row,) = depth_rows(run)
    assert run.has_depth and (row["n"], row["mean"], row["sd"], row["rmse"]) == (9, 0.01, 0.02, 0.0224)


# --- tables and figures --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def errors(folder):
    return [errors_of(run, None) for run in open_runs([folder / "run", folder / ODD])]


@pytest.fixture(scope="module")
def table(errors):
    rows = [row for e in errors for row in error_rows(e, Threshold(20.0))]
    return error_table(rows, Threshold(20.0), [ODD])


def test_latex_has_a_row_for_every_marker_and_escapes(table):
    for level, n_rows in (("run", 2), ("part", None), ("marker", 48)):
        text = latex(table, level)
        body = [line for line in text.splitlines() if line.endswith(r"\\")]
        rows = [line for line in body if len(re.findall(r"(?<!\\)&", line)) == len(table.columns)]
        assert n_rows is None or len(rows) == n_rows + 1  # and the heads
        assert not re.search(r"(?<!\\)[%#_](?!.*Needs)", "\n".join(body))
        for rule in ("toprule", "midrule", "bottomrule"):
            assert f"\\{rule}" in text
        assert text.count(r"\begin{tabular}") == text.count(r"\end{tabular}") == 1
    assert r"run\_1 \& 50\%\textdagger{}" in latex(table, "run") and r"beyond 20 px (\%)" in text


def test_latex_compiles_where_there_is_latex(table, tmp_path):
    import subprocess

    if shutil.which("pdflatex") is None:
        pytest.skip("there is no pdflatex on this computer")
    text = "".join(latex(table, level) for level in ("run", "part", "marker"))
    source = rf"\documentclass{{article}}\usepackage{{booktabs}}\begin{{document}}{text}\end{{document}}"
    (tmp_path / "t.tex").write_text(source, encoding="utf-8")
    done = subprocess.run(
        ["pdflatex", "-halt-on-error", "t.tex"], cwd=tmp_path, capture_output=True, timeout=60
    )
    assert done.returncode == 0, done.stdout[-2000:]


def test_markdown_and_csv(table, tmp_path):
    lines = markdown(table).splitlines()
    rows = [line for line in lines if line.startswith("| ")]
    widths = {len(re.findall(r"(?<!\\)\|", line)) for line in rows}
    assert widths == {len(table.columns) + 2, len(table.columns) + 3}
    assert r"run\_1 & 50%†" in markdown(table) and "20 px" in markdown(table)
    (tmp_path / "t.csv").write_text(as_csv(table), encoding="utf-8")
    read = pd.read_csv(tmp_path / "t.csv")
    assert len(read) == len(table.rows) and set(read.level) == {"run", "part", "marker"}
    assert read.rmse[0] == table.rows[0]["rmse"]


def test_histograms_share_their_axes_and_state_n(errors):
    figure = error_histograms(errors, errors, Threshold(20.0))
    panels = np.array(figure.axes).reshape(3, 2)
    for row in panels:
        assert len({axes.get_xlim() for axes in row}) == len({axes.get_ylim() for axes in row}) == 1
    assert panels[0, 0].get_xlim() == panels[1, 1].get_xlim()
    for e, axes in zip(errors, panels[2], strict=True):
        known = e.length[np.isfinite(e.length)]
        text = axes.texts[0].get_text()
        assert f"n {known.size:,}" in text and "> 20 px" in text
        places = [line.get_xdata()[0] for line in axes.lines if line.get_linestyle() == "--"]
        assert places == [pytest.approx(np.sqrt(np.mean(known**2)))]
        heights = axes.patches[0].get_data()
        assert heights.values.sum() == pytest.approx(100 * np.mean(known <= heights.edges[-1]))
    assert (
        panels[0, 1].get_title(loc="left").endswith("†") and "did not converge" in figure.texts[1].get_text()
    )
    assert len(error_markers(errors, errors).axes) == 2
