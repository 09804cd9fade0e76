"""Accuracy, seconds and memory of 3D tracks from moving cameras, beside a frame-by-frame OpenCV loop.

    python benchmarks/bench_scene.py [--data ../shared/data] [--runs 5] [--quick] [--json bench_scene.json]

Accuracy is that of the rig of four cameras with a wand (``mvt_rig``, ``mvt_rig_fisheye``; without these
folders it is left out), in mm, against what must be reached. The whole command runs in processes of its own;
memory is that of its largest process, and of all its processes together, where the system tells. Times grow
with simulated scenes of one, two and four times the frames. The loop does what two-view tools do: poses
linear in t and by SLERP, undistortion and two-view triangulation by OpenCV, a singular value decomposition
for more views, one frame after the other. It runs here; MultiViewTracks itself does not: its seconds are of
another machine.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from acino_fte.data_tools.scene import Scene, SceneResult
from acino_fte.data_tools.scene_points import triangulate_points
from acino_fte.data_tools.scene_rows import SceneRows, Views, scene_rows
from acino_fte.data_tools.scene_tracks import SceneTracks
from acino_fte.data_tools.similarity import Similarity
from acino_fte.data_tools.simulate_scene import SceneSimulation, random_gauge, simulate_scene

ROOT = Path(__file__).resolve().parents[1]
SETS = ("mvt_rig", "mvt_rig_fisheye")
SCALE, WAND = "1-3=0.6", 0.5
MVT = {  # its documented runs: RMSE in mm for the two sets, seconds and CPU seconds of 5,821 frames
    "wand": (5.8, 6.8),
    "position": (13.0, 15.2),
    "single": (32.0, 37.0),
    "wand, outliers": (35.7, 37.0),
}
MVT_S, MVT_CPU_S, MVT_CPU_GROWTH = 16.0, 11.5, {1: 11.5, 2: 41.4, 4: 160.0}
FRAMES = 5821
LAUNCHER = """
import json, resource, subprocess, sys, time
began = time.perf_counter()
code = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).returncode
seconds, usage = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps([code, seconds, usage.ru_utime + usage.ru_stime, usage.ru_maxrss]))
"""
GOALS = {"command": 2.5, "MiB": 300.0, "core": 0.2, "growth": 4.5}


def rmse(values: np.ndarray) -> float:
    """Of errors, or of vectors of errors (…, 3), in the unit of the values; NaN for none."""
    squared = values**2 if values.ndim == 1 else (values**2).sum(1)
    return float(np.sqrt(squared.mean())) if len(squared) else float("nan")


class Wand:
    """The true places of the wand's ends, in the world of the COLMAP model's own gauge."""

    def __init__(self, folder: Path) -> None:
        import pandas as pd

        gauge = json.loads((folder / "scene.json").read_text())
        turn, centre = np.array(gauge["Rg"]), np.array(gauge["c"])
        self.world_from_model = Similarity(1.0 / gauge["s"], turn.T, centre)
        table = pd.read_csv(folder / "gt_points.csv")
        self.place = {
            (str(i), int(f)): k for k, (i, f) in enumerate(zip(table.identity, table.frame, strict=True))
        }
        self.position = table[["x", "y", "z"]].to_numpy(float)
        self.n_views = table.n_views.to_numpy()

    def score(self, tracks: SceneTracks, factor: float) -> dict[str, float]:
        """Errors of tracks in the model's world: mm, and NEES/3 of points of two views or more.

        `factor` is the scale that the known distance gives; positions are in the true gauge.
        """
        names = [tracks.individuals[i] for i in tracks.individual]
        row = np.array([self.place[key] for key in zip(names, tracks.frame.tolist(), strict=True)])
        error = self.world_from_model.points(tracks.position) - self.position[row]
        covariance = self.world_from_model.covariance(tracks.covariance)
        views = (tracks.source == 0) & (self.n_views[row] >= 2)
        single = tracks.source == 1
        nees = (error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(1) / 3.0
        wand, both = self._wand(tracks, factor)
        return {
            "wand": 1e3 * rmse(wand[both]),
            "wand p95": 1e3 * float(np.quantile(np.abs(wand[both]), 0.95)),
            "wand max": 1e3 * float(np.abs(wand).max()),
            "position": 1e3 * rmse(error[views]),
            "single": 1e3 * rmse(error[single]),
            "NEES/3": float(nees[views].mean()),
            "NEES/3 single": float(nees[single].mean()) if single.any() else float("nan"),
            "kept": float(views.sum() / (self.n_views >= 2).sum()),
        }

    @staticmethod
    def _wand(tracks: SceneTracks, factor: float) -> tuple[np.ndarray, np.ndarray]:
        """Errors of the wand's length in all common frames, m, and whether two views saw both ends."""
        ends = [np.flatnonzero(tracks.individual == k) for k in range(2)]
        _, i, j = np.intersect1d(tracks.frame[ends[0]], tracks.frame[ends[1]], return_indices=True)
        i, j = ends[0][i], ends[1][j]
        length = factor * np.linalg.norm(tracks.position[i] - tracks.position[j], axis=1)
        return length - WAND, (tracks.source[i] == 0) & (tracks.source[j] == 0)


def scale_of(scene: Scene) -> float:
    """Metres per unit of the model, from the known distance of two cameras."""
    placed = scene.placed(scale=[SCALE], gravity="none")
    assert placed.scale is not None
    return placed.scale.factor


def accuracy(folder: Path) -> dict[str, dict[str, float]]:
    """Scores of every way to triangulate a set."""
    wand, scores = Wand(folder), {}
    scene = Scene.from_colmap(folder)
    factor = scale_of(scene)
    result = scene.triangulate()
    scores["rig, not smoothed"] = wand.score(result.points, factor)
    scores["rig, smoothed"] = wand.score(result.tracks, factor)
    alone = scene.triangulate("none")
    scores["no rig, not smoothed"] = wand.score(alone.points, factor)
    scores["no rig, smoothed"] = wand.score(alone.tracks, factor)
    wild = Scene.from_colmap(folder, "tracks_outlier").triangulate()
    scores["outliers, not smoothed"] = wand.score(wild.points, factor)
    scores["outliers, smoothed"] = wand.score(wild.tracks, factor)
    scores["another gauge"] = {"largest change": gauge_change(scene, result)}
    return scores


def gauge_change(scene: Scene, result: SceneResult, n: int = 3) -> float:
    """Largest change of a metric position when the model's world is turned, moved and scaled, m."""
    change = 0.0
    reference = scene.placed(scale=[SCALE]).triangulate().tracks.position
    for seed in range(n):
        other = scene.moved(random_gauge(seed)).placed(scale=[SCALE]).triangulate().tracks.position
        same = other.shape == reference.shape
        change = max(change, float(np.abs(other - reference).max()) if same else float("inf"))
    return change


def must_reach(scores: dict[str, dict[str, float]], which: int) -> list[tuple[str, float, str, bool]]:
    """Rows (what, number, limit, reached) of the table that must be reached, for the set number `which`."""
    rig, plain = scores["rig, smoothed"], scores["rig, not smoothed"]
    alone, wild = scores["no rig, not smoothed"], scores["outliers, smoothed"]
    rough = scores["outliers, not smoothed"]
    above = [
        ("wand, rig, not smoothed, mm", plain["wand"], (3.3, 3.5)[which]),
        ("position, rig, not smoothed, mm", plain["position"], 7.5),
        ("wand, no rig, mm", alone["wand"], MVT["wand"][which]),
        ("position, no rig, mm", alone["position"], 0.93 * MVT["position"][which]),
        ("wand, smoothed, mm", rig["wand"], 2.0),
        ("position, smoothed, mm", rig["position"], 4.5),
        ("position of single views, mm", rig["single"], 32.0),
        ("largest wand error, mm", rig["wand max"], 200.0),
        ("wand, outliers, smoothed, mm", wild["wand"], 2.5),
        ("wand p95, outliers, not smoothed, mm", rough["wand p95"], 10.0),
        ("change in another gauge, m", scores["another gauge"]["largest change"], 1e-6),
    ]
    rows = [(what, value, f"≤ {limit:.3g}", value <= limit) for what, value, limit in above]
    rows.append(("points kept, outliers", rough["kept"], "≥ 0.98", rough["kept"] >= 0.98))
    for name in ("rig, not smoothed", "rig, smoothed", "no rig, not smoothed", "outliers, smoothed"):
        value = scores[name]["NEES/3"]
        rows.append((f"NEES/3, {name}", value, "0.8–1.3", 0.8 <= value <= 1.3))
    return rows


def fresh(arguments: list[str], watch: bool = False) -> dict[str, float]:
    """Run the command in a process of its own: seconds, CPU seconds, MiB of its largest process.

    A small process starts it: a child's peak memory counts what its parent had. With `watch` the memory of
    all its processes together is asked for while it runs, which takes time.
    """
    program = [sys.executable, str(ROOT / "scripts" / "triangulate_scene.py"), *arguments, "--quiet"]
    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    surroundings = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    launch = [sys.executable, "-c", LAUNCHER, *program]
    with subprocess.Popen(launch, env=surroundings, stdout=subprocess.PIPE, text=True) as launcher:
        memory: list[float] = []
        if watch:
            watched(launcher, memory)
        answer, _ = launcher.communicate()
    code, seconds, cpu, peak = json.loads(answer)
    if code:
        raise SystemExit(f"The command failed: {' '.join(program)}")
    found = {"seconds": seconds, "cpu": cpu, "MiB": peak / 1024.0}
    return found | {"MiB together": max(memory, default=float("nan"))}


def watched(process: subprocess.Popen, memory: list[float], pause: float = 0.1) -> None:
    """Add the proportional memory of a process and its descendants to a list while it runs, MiB (Linux)."""

    def watch() -> None:
        while process.poll() is None:
            with contextlib.suppress(OSError, ValueError, StopIteration):
                memory.append(sum(map(_memory, _family(process.pid))) / 1024.0)
            time.sleep(pause)

    threading.Thread(target=watch, daemon=True).start()


def _family(pid: int) -> list[int]:
    """A process and all that descend from it."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [pid, *(k for child in children for k in _family(int(child)))]


def _memory(pid: int) -> float:
    """Proportional set size, KiB."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return float(next(line for line in lines if line.startswith("Pss:")).split()[1])


def command(folder: Path, runs: int, extra: list[str]) -> dict[str, float]:
    """Fastest and median of several runs of the whole command."""
    with tempfile.TemporaryDirectory() as out:
        arguments = [str(folder), "-o", str(Path(out) / "scene"), *extra]
        found = [fresh(arguments) for _ in range(runs)]
        together = fresh(arguments, watch=True)["MiB together"]
    return {
        "best": min(one["seconds"] for one in found),
        "median": statistics.median(one["seconds"] for one in found),
        "cpu": min(one["cpu"] for one in found),
        "MiB": max(one["MiB"] for one in found),
        "MiB together": together,
    }


def timed(job: Callable[[], Any], runs: int) -> tuple[float, float]:
    """Fastest and median seconds of a job."""
    seconds = []
    for _ in range(runs):
        began = time.perf_counter()
        job()
        seconds.append(time.perf_counter() - began)
    return min(seconds), statistics.median(seconds)


def core(folder: Path, runs: int) -> dict[str, Any]:
    """Seconds of triangulation and covariance of rows that are ready, and of the OpenCV loop on them."""
    scene = Scene.from_colmap(folder)
    views = scene.camera_paths("auto").views
    rows = scene_rows(views, scene.tracks, scene.individuals)
    best, median = timed(lambda: triangulate_points(rows, views), max(runs, 5))
    wand, factor = Wand(folder), scale_of(scene)
    began = time.perf_counter()
    loop = opencv_loop(scene, views, rows)
    loop_seconds = time.perf_counter() - began
    tracks = scene.triangulate("none").points
    return {
        "best": best,
        "median": median,
        "loop": loop_seconds,
        "loop scores": wand.score(_as_tracks(tracks, rows, loop), factor),
    }


def opencv_loop(scene: Scene, views: Views, rows: SceneRows) -> np.ndarray:
    """Points (T, 3) of all rows, one after the other, NaN where one view alone saw them."""
    normal = np.empty_like(rows.measured.xy)
    poses = []
    for c, camera in enumerate(scene.cameras):
        mine, lens = rows.camera == c, camera.lens
        dots = rows.measured.xy[mine][:, None]
        undistort = cv2.fisheye.undistortPoints if lens.model == "fisheye" else cv2.undistortPoints
        normal[mine] = undistort(dots, lens.matrix, lens.distortion).reshape(-1, 2)
        every = np.arange(camera.frame[0], camera.frame[-1] + 1)
        turn = Slerp(camera.frame, Rotation.from_matrix(camera.rotation))(every).as_matrix()
        shift = np.stack([np.interp(every, camera.frame, t) for t in camera.translation.T], axis=-1)
        poses.append((int(every[0]), np.concatenate([turn, shift[..., None]], axis=2)))
    position = np.full((rows.n_points, 3), np.nan)
    order = np.argsort(rows.point, kind="stable")
    for dots in np.split(order, np.flatnonzero(np.diff(rows.point[order])) + 1):
        if len(dots) < 2:
            continue
        point = rows.point[dots[0]]
        frame = int(rows.frame[point])
        matrices: list[Any] = []
        for k in dots:
            begin, pose = poses[rows.camera[k]]
            matrices.append(pose[min(max(frame - begin, 0), len(pose) - 1)])
        if len(dots) == 2:
            first, second = matrices
            x = cv2.triangulatePoints(first, second, normal[dots[0]], normal[dots[1]])[:, 0]
        else:
            system = np.concatenate(
                [normal[k][:, None] * m[2] - m[:2] for k, m in zip(dots, matrices, strict=True)]
            )
            x = np.linalg.svd(system)[2][-1]
        position[point] = x[:3] / x[3]
    return position


def _as_tracks(like: SceneTracks, rows: SceneRows, position: np.ndarray) -> SceneTracks:
    """Points as tracks without covariances, of two views or more."""
    good = np.isfinite(position[:, 0])
    n = int(good.sum())
    return replace(
        like,
        individual=rows.individual[good],
        frame=rows.frame[good],
        position=position[good],
        covariance=np.tile(np.eye(3), (n, 1, 1)),
        source=np.zeros(n, dtype=int),
        n_views=np.bincount(rows.point, minlength=rows.n_points)[good],
    )


def growth(runs: int, times: tuple[int, ...] = (1, 2, 4)) -> dict[int, dict[str, float]]:
    """Seconds of the whole command and of its computing, for scenes of 1, 2, 4 times the frames."""
    from acino_fte.data_tools.scene_folder import write_scene

    found: dict[int, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as place:
        for factor in times:
            scene = simulate_scene(SceneSimulation(n_frames=factor * FRAMES, n_animals=0, lane=25.0, seed=5))
            folder = Path(place) / f"x{factor}"
            write_scene(scene, folder)
            found[factor] = command(folder, runs, [])
            read = Scene.from_colmap(folder)
            found[factor]["triangulate"] = timed(read.triangulate, runs)[0]
    return found


def report(name: str, scores: dict[str, dict[str, float]], which: int) -> str:
    """The table of accuracy of one set."""
    lines = [f"\n{name}: RMSE, mm"]
    columns = ("wand", "wand p95", "wand max", "position", "single", "NEES/3", "NEES/3 single", "kept")
    lines.append(f"{'':26s}" + "".join(f"{column:>14s}" for column in columns))
    for way, score in scores.items():
        if "wand" in score:
            lines.append(f"{way:26s}" + "".join(f"{score[column]:14.2f}" for column in columns))
    lines.append(
        f"{'MultiViewTracks (cited)':26s}{MVT['wand'][which]:14.2f}{'':28s}{MVT['position'][which]:14.2f}"
        f"{MVT['single'][which]:14.2f}   with outliers: wand {MVT['wand, outliers'][which]:.1f}"
    )
    for what, value, limit, reached in must_reach(scores, which):
        lines.append(f"  {'reached' if reached else 'MISSED ':8s} {what:42s} {value:10.4g}  {limit}")
    return "\n".join(lines)


def speed_report(speed: dict[str, float], parts: dict[str, Any]) -> str:
    """Seconds, memory and ratios."""
    loop = parts["loop scores"]
    lines = [
        f"\nwhole command, {FRAMES} frames: best {speed['best']:.2f} s, median {speed['median']:.2f} s "
        f"(aim: {GOALS['command']:g}), CPU {speed['cpu']:.2f} s",
        f"    MultiViewTracks (cited): {MVT_S:g} s, CPU {MVT_CPU_S:g} s: {MVT_S / speed['best']:.1f} times "
        f"ours, {MVT_CPU_S / speed['cpu']:.1f} times our CPU",
        f"    memory: largest process {speed['MiB']:.0f} MiB, all {speed['MiB together']:.0f} MiB "
        f"(aim: {GOALS['MiB']:g})",
        f"core (triangulation, noise, covariance): best {parts['best']:.3f} s, "
        f"median {parts['median']:.3f} s (aim: {GOALS['core']:g})",
        f"    OpenCV frame by frame, here: {parts['loop']:.2f} s, {parts['loop'] / parts['best']:.1f} times "
        f"ours; wand {loop['wand']:.1f} mm, position {loop['position']:.1f} mm, no covariance",
    ]
    return "\n".join(lines)


def growth_report(grown: dict[int, dict[str, float]]) -> str:
    """How times grow with the frames."""
    lines, first = [], grown[1]
    for factor, one in grown.items():
        lines.append(
            f"{factor} x {FRAMES} frames (simulated): command {one['best']:.2f} s "
            f"({one['best'] / first['best']:.2f} x), CPU {one['cpu']:.2f} s ({one['cpu'] / first['cpu']:.2f} "
            f"x), {one['MiB']:.0f} MiB; paths to tracks {one['triangulate']:.2f} s "
            f"({one['triangulate'] / first['triangulate']:.2f} x); MultiViewTracks (cited) "
            f"{MVT_CPU_GROWTH[factor]:g} s CPU ({MVT_CPU_GROWTH[factor] / MVT_CPU_GROWTH[1]:.1f} x)"
        )
    lines.append(f"(aim: 4 times the frames in {GOALS['growth']:g} times the time)")
    return "\n".join(lines)


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", type=Path, default=ROOT.parent / "shared" / "data", help="where the sets are"
    )
    parser.add_argument("--runs", type=int, default=5, help="runs of the whole command")
    parser.add_argument("--quick", action="store_true", help="without the larger scenes")
    parser.add_argument("--json", type=Path, help="write all numbers")
    given = parser.parse_args()
    found: dict[str, Any] = {}
    for which, name in enumerate(SETS):
        folder = given.data / name
        if not folder.is_dir():
            print(f"{name}: not there ({folder}), left out")
            continue
        scores = accuracy(folder)
        found[name] = {"accuracy": scores}
        print(report(name, scores, which), flush=True)
        speed = command(folder, given.runs, ["--rig", "auto", "--scale", SCALE])
        parts = core(folder, given.runs)
        found[name] |= {"command": speed, "core": parts}
        print(speed_report(speed, parts), flush=True)
    if not given.quick:
        found["growth"] = growth(max(given.runs // 2, 1))
        print("\n" + growth_report(found["growth"]))
    if given.json:
        given.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
