"""``acino-fte rig record``: what it says, and how it leaves."""

import os
import signal
import threading

import pytest
from typer.testing import CliRunner

from acino_fte.cli import app
from acino_fte.cli_rig_record import status_line
from acino_fte.data_tools.rig_recording import read_manifest
from acino_fte.rig.recorder_types import Status
from acino_fte.rig.rig_file import CameraPart, LidarPart, RigFile, Storage
from acino_fte.rig.rig_read import write_rig

RIG = RigFile(
    name="small",
    cameras={"cam1": CameraPart(width=64, height=48)},
    lidars={"lidar1": LidarPart(points=20, imu_hz=20.0)},
    storage=Storage(reserve_gb=0.01),
)


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_rig("rig.yaml", RIG)

    def invoke(*args):
        found = CliRunner().invoke(app, ["rig", "record", *args], env={"COLUMNS": "200"})
        return found.exit_code, " ".join(found.output.split())

    return invoke


def test_a_good_recording_leaves_with_0(run, tmp_path):
    code, said = run("--simulate", "--fast", "--minutes", "0.03", "--fault", "stall:cam1@0.5+1")
    (folder,) = tmp_path.glob("small-*")
    manifest = read_manifest(folder)
    assert code == 0 and manifest.state == "closed" and manifest.simulated
    assert "at 0.50 s: stall cam1 for 1.00 s, 60 missing" in said
    assert "cam1 48, lidar1/points 18, lidar1/imu 36" in said
    assert f"rig check {folder.name}" in said


def test_a_full_disk_before_the_end_leaves_with_1(run, tmp_path):
    code, said = run("--simulate", "--fast", "--minutes", "0.05", "--fault", "disk@1", "--out", "a", "-q")
    assert code == 1 and "at 1.00 s: disk full" in said
    assert read_manifest(tmp_path / "a").state == "closed"


def test_ctrl_c_closes_in_good_order(run, tmp_path):
    before = signal.getsignal(signal.SIGINT)

    def press():
        while not (tmp_path / "a" / "cam1-0000.mkv").exists():
            pass
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=press, daemon=True).start()
    code, said = run("--simulate", "--out", "a")
    manifest = read_manifest(tmp_path / "a")
    assert code == 0 and manifest.state == "closed"
    assert manifest.events[-1].kind == "stopped" and manifest.events[-1].detail == "Ctrl-C"
    assert all(segment.closed for segment in manifest.segments)
    assert signal.getsignal(signal.SIGINT) == before


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("--simulate", "rigg.yaml"), "does not exist"),
        (("--simulate", "empty"), "holds no rig.yaml"),
        (("--simulate", "wrong.yaml"), "not a rig file"),
        ((), "add --simulate to try"),
        (("--fast",), "add --simulate"),
        (("--simulate", "--fault", "stal:cam1@1+1"), "did you mean 'stall'"),
        (("--simulate", "--minutes", "0"), "no time to record"),
        (("--simulate", "--lidar-every", "0"), "1 or more"),
        (("--simulate", "--out", "empty/../wrong.yaml"), "something already"),
    ],
)
def test_what_cannot_be_is_said_and_leaves_with_2(run, tmp_path, args, says):
    (tmp_path / "empty").mkdir()
    (tmp_path / "wrong.yaml").write_text("hello")
    code, said = run(*args)
    assert code == 2 and says in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "rig.yaml", "wrong.yaml"]


def test_a_disk_without_room_is_refused(run, tmp_path):
    write_rig("rig.yaml", RIG.model_copy(update={"storage": Storage(reserve_gb=1e9)}))
    code, said = run("--simulate")
    assert code == 2 and "room for 0 min" in said and "free some space" in said
    assert not list(tmp_path.glob("small-*"))


def test_the_line_says_what_matters():
    status = Status(
        "recording", 83.4, {"cam1": 59.9, "/cam1/info": 59.9, "/lidar1/points": 10.0}, {}, 2, 1,
        ("/lidar1/imu",), True, 80_400_000_000, 169.2, 0.1,
    )  # fmt: skip
    assert status_line(status) == (
        "RECORDING 01:23 | cam1 60/s lidar1/points 10/s | SILENT: lidar1/imu | LENS MOVED | "
        "dropped 2, lost 1 | 80.4 GB free, 2.8 h left"
    )
