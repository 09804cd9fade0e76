"""Checks of a recorder's folder: every induced fault is found with its time and length, and nothing else."""

import json

import numpy as np
import pytest

pytest.importorskip("rosbags")
pytest.importorskip("mcap")
pytest.importorskip("av")

from rig_check_folders import IMAGE, IMU, INFO, POINTS, START, Faults, write_folder

from acino_fte.data_tools.rig_recording import Event
from acino_fte.rig.check import check_recording
from acino_fte.rig.check_report import json_text, page, write_files
from acino_fte.rig.check_types import DAMAGED

FAULTS = Faults(
    stalls={INFO: (4.0, 2.0), IMU: (7.5, 1.5)},
    lost_frames=(50, 51, 52, 330),
    unfilmed=(20,),
    wall_jumps=((3.5, 5.0), (9.0, -5.0)),
    device_jumps={POINTS: (6.0, -100.0)},
    drift={IMU: 300e-6},
    twice={IMU: 200},
    swapped={POINTS: 30},
    spikes={240: 64, 300: -4096, 301: -4096},
    zoomed=(9.5, 10.5),
    exposure=(10.0, 2000.0),
    thin=(90, 91),
)


def event(kind, time, stream="", seconds=0.0, count=0):
    return Event(kind, START + round(time * 1e9), stream, seconds, count)


TOLD = (
    event("lost", 1.67, "cam1", 0.1, 3),
    event("clock_jump", 3.5, seconds=5.0),
    event("stall", 4.0, "cam1", 2.0, 60),
    event("stall", 7.5, "/lidar1/imu", 1.5, 150),
    event("lens_moved", 9.57, "cam1", 1.9),
)


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    return check_recording(write_folder(tmp_path_factory.mktemp("clean") / "clean", seconds=6.0))


@pytest.fixture(scope="module")
def faulty(tmp_path_factory):
    return check_recording(write_folder(tmp_path_factory.mktemp("faulty") / "faulty", FAULTS, events=TOLD))


def since(time_ns):
    return (time_ns - START) * 1e-9


def verdicts(check):
    return {(one.name, one.subject): one.verdict for one in check.requirements}


def test_nothing_is_found_in_a_clean_recording(clean):
    assert clean.verdict == "pass" and clean.unexplained == ()
    assert set(verdicts(clean).values()) == {"pass"}
    assert {s.name: (s.count, s.lost, s.gaps) for s in clean.found.streams.values()} == {
        INFO: (180, 0, []), POINTS: (60, 0, []), IMU: (600, 0, []), IMAGE: (180, 0, [])
    }  # fmt: skip
    for stream in clean.found.streams.values():
        assert stream.jumps == [] and stream.delta_loss == 1.0
        assert stream.duplicates == stream.out_of_order == 0
    for name, hz in ((INFO, 30.0), (POINTS, 10.0), (IMU, 100.0)):
        assert clean.found.streams[name].rate_hz == pytest.approx(hz, rel=1e-5)
    assert clean.found.wall.jumps == []
    camera = clean.found.cameras[INFO]
    assert camera.n_glitches == camera.n_exposures == camera.n_without == 0 and camera.lens == []


def test_gaps_have_their_true_times_and_lengths(faulty):
    """To a period of the stream: the data tell no more."""
    found = {name: stream.gaps for name, stream in faulty.found.streams.items()}
    expected = {
        INFO: [(50 / 30, 0.1, 3), (4.0, 2.0, 60), (11.0, 1 / 30, 1)],
        IMU: [(7.5, 1.5, 150)],
        POINTS: [],
        IMAGE: [(20 / 30, 1 / 30, 1)],
    }
    for name, gaps in expected.items():
        period = 1 / faulty.found.streams[name].rate_hz
        assert [gap.lost for gap in found[name]] == [lost for *_, lost in gaps], name
        for gap, (start, length, _) in zip(found[name], gaps, strict=True):
            assert since(gap.start_ns) == pytest.approx(start, abs=period)
            assert gap.seconds == pytest.approx(length, abs=0.5 * period)


def test_delta_loss_is_that_of_the_thesis(faulty):
    """Expected over recorded frames: 360 exposed, 64 lost."""
    assert faulty.found.streams[INFO].delta_loss == pytest.approx(360 / 296)
    assert faulty.found.streams[IMU].lost_share == pytest.approx(150 / 1200)
    longest = faulty.found.streams[INFO].longest_whole_s
    assert longest == pytest.approx(5.0, abs=0.05)  # from 6 s to the frame lost at 11 s


def test_clocks(faulty):
    jumps = faulty.found.wall.jumps
    assert [(round(since(j.time_ns), 2), j.seconds) for j in jumps] == [
        (pytest.approx(3.5, abs=0.02), pytest.approx(5.0, abs=1e-3)),
        (pytest.approx(9.0, abs=0.02), pytest.approx(-5.0, abs=1e-3)),
    ]
    (restart,) = faulty.found.streams[POINTS].jumps
    assert since(restart.time_ns) == pytest.approx(6.0, abs=0.1)
    assert restart.seconds == pytest.approx(-100.0, abs=1e-3)
    imu = faulty.found.streams[IMU]
    assert imu.drift_ppm == pytest.approx(300.0, abs=5 * imu.drift_sd_ppm) and imu.drift_sd_ppm < 3
    assert imu.jumps == [] and faulty.found.streams[INFO].jumps == []
    assert verdicts(faulty)["clock drift", IMU] == "warn"


def test_order_of_messages(faulty):
    streams = faulty.found.streams
    assert {n: (s.duplicates, s.out_of_order) for n, s in streams.items()} == {
        INFO: (0, 0), IMU: (1, 0), POINTS: (0, 1), IMAGE: (0, 0)
    }  # fmt: skip


def test_camera(faulty):
    camera = faulty.found.cameras[INFO]
    assert [(round(since(t), 1), place, size) for t, place, size in camera.glitches] == [
        (8.0, 0, 64), (10.0, 0, pytest.approx(-4096, abs=10))  # while the zoom turns by 10 a frame
    ]  # fmt: skip
    ((start, end, place, far),) = camera.lens
    assert (since(start), since(end)) == pytest.approx((9.567, 10.933), abs=0.05)
    assert place == 0 and far == pytest.approx(150, abs=2)
    assert [(round(since(t), 1), a, b) for t, a, b in camera.exposures] == [(10.0, 1000.0, 2000.0)]
    assert camera.n_without == 1 and since(camera.without_picture[0]) == pytest.approx(20 / 30, abs=0.01)
    assert camera.pictures == 24 and camera.over == camera.under == 0


def test_lidar(faulty):
    lidar = faulty.found.lidars[POINTS]
    assert lidar.returns == 100 and lidar.n_thin == 2
    assert [round(since(t), 1) for t in lidar.thin] == [9.0, 9.1]
    assert lidar.holes_judged and lidar.datagrams_lost == 0


def test_what_events_explain_and_what_they_do_not(faulty):
    said = " | ".join(faulty.unexplained)
    assert len(faulty.unexplained) == 4
    for told in (
        "/cam1/info: 1 are missing for 0.03 s from 11.00 s on",
        "/cam1/image: 1 are missing",
        "/lidar1/points: its clock jumped by -100.000 s at 6.00 s",
        "wall clock jumped by -5.000 s at 9.00 s",
    ):
        assert told in said
    gaps = faulty.found.streams[INFO].gaps
    assert [bool(gap.explained) for gap in gaps] == [True, True, False]
    assert "stall at 4.00 s" in gaps[1].explained


def test_the_verdict_names_number_limit_and_remedy(faulty):
    assert faulty.verdict == "fail"
    found = verdicts(faulty)
    assert found["no loss", INFO] == found["no loss", IMU] == found["explained", "events and data"] == "fail"
    assert found["no loss", POINTS] == found["rate", INFO] == "pass"
    for one in faulty.requirements:
        assert one.found and one.limit and bool(one.remedy) == (one.verdict != "pass"), one


def test_events_that_the_data_do_not_show(tmp_path):
    events = (
        event("stall", 1.0, "/lidar1/points", 2.0, 20),
        event("clock_jump", 2.0, seconds=-5.0),
        event("disk_full", 1.0),
        event("lens_moved", 3.0, "cam1"),
    )
    check = check_recording(write_folder(tmp_path / "told", seconds=5.0, events=events, video=False))
    said = " | ".join(check.unexplained)
    assert len(check.unexplained) == 4 and check.verdict == "fail"
    for told in ("the data have no gap there", "no such jump", "the data go on", "no such move"):
        assert told in said


def test_a_wrong_length_and_counts_that_differ_are_told(tmp_path):
    path = write_folder(
        tmp_path / "told", Faults(stalls={IMU: (1.0, 2.0)}), seconds=5.0, video=False,
        events=(event("stall", 1.0, "/lidar1/imu", 1.0, 100),),
    )  # fmt: skip
    manifest = path / "manifest.json"
    content = json.loads(manifest.read_text())
    content["streams"][1]["written"] += 7
    manifest.write_text(json.dumps(content))
    said = check_recording(path).unexplained
    assert any("of 1.00 s: the data show 2.00 s" in text for text in said)
    assert any("57 were written, 50 are there" in text for text in said) and len(said) == 2


@pytest.mark.parametrize("at", [0.0, 3.0])
def test_silence_at_the_start_and_until_the_end_is_a_gap(tmp_path, at):
    path = write_folder(tmp_path / "rig", Faults(stalls={IMU: (at, 2.0)}), seconds=5.0, video=False)
    (gap,) = check_recording(path).found.streams[IMU].gaps
    assert (since(gap.start_ns), gap.seconds) == pytest.approx((at, 2.0), abs=0.02)
    assert gap.lost == pytest.approx(200, abs=1) and not gap.explained


def test_a_rate_that_is_not_the_rigs_and_bad_exposure(tmp_path):
    path = write_folder(tmp_path / "rig", Faults(rates={INFO: 25.0}, brightness=255), seconds=4.0)
    found = verdicts(check_recording(path))
    assert found["rate", INFO] == "fail" and found["exposure", INFO] == "warn"
    assert found["no loss", INFO] == "pass"
    dark = check_recording(write_folder(tmp_path / "dark", Faults(brightness=0), seconds=2.0))
    assert "take off the cap" in next(one.remedy for one in dark.requirements if one.name == "exposure")


def test_cut_and_lost_files(tmp_path):
    path = write_folder(tmp_path / "rig", seconds=6.0, segment_s=3.0, state="recording")
    file = path / "messages-0001.mcap"
    file.write_bytes(file.read_bytes()[:-9_000])
    check = check_recording(path)
    found = verdicts(check)
    assert found["closed", "the recording"] == "warn" and found["readable", "the files"] != "pass"
    assert "recover" in next(one.remedy for one in check.requirements if one.name == "readable")
    for file in path.iterdir():
        if file.suffix == ".mcap":
            file.write_bytes(b"")
    check = check_recording(path)
    assert check.verdict == "fail" and "nothing can be read" in check.requirements[0].found
    assert json.loads(json_text(check))["verdict"] == "fail"


@pytest.mark.parametrize(("state", "n_unexplained"), [("recording", 1), ("recovered", 1), ("closed", 2)])
def test_what_was_on_its_way_when_a_recording_was_cut_short_is_explained(tmp_path, state, n_unexplained):
    """The last pictures, but none before."""
    path = write_folder(tmp_path / "rig", Faults(unfilmed=(10, 118, 119)), seconds=4.0, state=state)
    check = check_recording(path)
    assert [gap.lost for gap in check.found.streams[IMAGE].gaps] == [1, 2]
    assert len(check.unexplained) == n_unexplained


def test_a_lost_or_empty_file_explains_what_is_missing(tmp_path):
    path = write_folder(tmp_path / "rig", seconds=6.0, segment_s=2.0)
    (path / "cam1-0000.mkv").write_bytes(b"")
    (path / "messages-0001.mcap").unlink()
    check = check_recording(path)
    assert check.verdict == "fail" and check.unexplained == ()
    assert {gap.explained for stream in check.found.streams.values() for gap in stream.gaps} == {DAMAGED}
    assert [any(n in p for p in check.found.damage.places) for n in ("cam1-0000", "messages-0001")] == [
        True
    ] * 2


@pytest.mark.parametrize("name", ["messages-0001.mcap", "messages-0000.mcap"])
def test_a_recovered_copy_is_not_blamed_for_the_cut(tmp_path, name):
    """The end that is missing is a warning; a hole in the middle fails, but is explained."""
    from acino_fte.rig.recover import recover

    told = (event("stall", 3.95, "cam1", 0.5, 15),)
    path = write_folder(tmp_path / "rig", seconds=4.0, segment_s=2.0, state="recording", events=told)
    file = path / name
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 3])
    recover(path, tmp_path / "copy")
    check = check_recording(tmp_path / "copy")
    assert check.unexplained == () and check.found.damage.whole
    loss = [one for one in check.requirements if one.name == "no loss" and one.subject != IMAGE]
    if name == "messages-0001.mcap":
        assert check.verdict == "warn" and {one.verdict for one in loss} <= {"pass", "warn"}
    else:
        assert all("in damaged files" in one.found and one.verdict == "fail" for one in loss)
    assert not any("recover" in one.remedy or "authors" in one.remedy for one in check.requirements)


def test_without_its_manifest_there_is_nothing_to_explain(tmp_path):
    path = write_folder(tmp_path / "rig", Faults(stalls={IMU: (1.0, 1.0)}), seconds=4.0, manifest=False)
    check = check_recording(path)
    assert check.unexplained == () and check.verdict == "fail"
    assert "explained" not in {one.name for one in check.requirements}
    assert verdicts(check)["closed", "the recording"] == "warn"
    (gap,) = check.found.streams[IMU].gaps
    assert gap.lost == 100


@pytest.mark.parametrize("every", [False, True])
def test_pictures_in_damaged_bytes_are_missed(tmp_path, every):
    path = write_folder(tmp_path / "rig", seconds=2.0)
    file = path / "cam1-0000.mkv"
    data = bytearray(file.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 2000] = b"\xff" * 2000
    file.write_bytes(data)
    check = check_recording(path, every_frame=every)
    n = 60 - check.found.streams[IMAGE].count
    assert 0 < n < 40 and check.verdict == "fail"
    if every:
        assert any("cam1-0000.mkv" in place for place in check.found.damage.places)
    else:
        assert any("/cam1/image" in text for text in check.unexplained)


def test_json_page_and_picture(faulty, tmp_path):
    content = json.loads(json_text(faulty))
    assert content["format"] == "acino-fte/rig-check/1" and content["verdict"] == "fail"
    info = next(stream for stream in content["streams"] if stream["name"] == INFO)
    assert [round(gap["time_s"], 1) for gap in info["gaps"]] == [1.7, 4.0, 11.0]
    assert content["wall_clock"]["jumps"][0]["seconds"] == pytest.approx(5.0, abs=1e-3)
    assert len(content["unexplained"]) == 4
    write_files(faulty, tmp_path)
    html = (tmp_path / "check.html").read_text()
    assert "http" not in html.replace("http-equiv", "") and "data:image/png;base64," in html
    assert (
        "FAIL" in html and "/cam1/info" in html and "@" not in html.split("<body>")[0].replace("@media", "")
    )
    from PIL import Image

    pixels = np.asarray(Image.open(tmp_path / "timeline.png").convert("RGB"))
    red = (pixels == (213, 94, 0)).all(axis=-1)  # gaps
    assert red.any(axis=0).sum() > 0.2 * pixels.shape[1]  # 3.5 s of 12 s
    assert page(faulty, b"").count("<tr") > 30


def test_names_are_escaped(tmp_path):
    check = check_recording(write_folder(tmp_path / "<b>rig@title@", seconds=1.0, video=False))
    assert "<b>rig" not in page(check, b"") and "&lt;b&gt;rig@title@" in page(check, b"")
