"""The folder of the rig's recorder read as one recording, whole and damaged."""

import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("rosbags")
pytest.importorskip("mcap")
pytest.importorskip("av")

from rig_check_folders import IMAGE, IMU, INFO, POINTS, START, Faults, write_folder

from acino_fte.data_tools.import_pictures import MessagePictures
from acino_fte.data_tools.import_scan import scan_recording
from acino_fte.data_tools.open_recording import open_recording, recording_kind
from acino_fte.data_tools.recording import Picture
from acino_fte.data_tools.rig_reader import RigReader
from acino_fte.data_tools.rig_recording import MANIFEST, read_manifest
from acino_fte.errors import InputError

COUNTS = {INFO: 120, POINTS: 40, IMU: 400, IMAGE: 120}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """4 s in two segments of 2 s."""
    return write_folder(tmp_path_factory.mktemp("rig") / "whole", seconds=4.0, segment_s=2.0)


@pytest.fixture
def folder(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "copy")


def shown(picture):
    """The number, to 16, that a picture shows."""
    return int(picture.pixels[..., 0].mean(axis=0).reshape(16, 4).mean(axis=1).argmax())


def numbers(reader):
    """Numbers of the pictures; each shows its own."""
    out = []
    for record in reader.records(kinds=["image"]):
        assert shown(record.value) == record.value.number % 16
        out.append(record.value.number)
    return out


def test_all_segments_are_one_recording(whole):
    assert recording_kind(whole) == "rig"
    with open_recording(whole) as reader:
        assert isinstance(reader, RigReader)
        assert {s.name: s.count for s in reader.streams} == COUNTS
        assert {s.name: s.kind for s in reader.streams}[IMAGE] == "image"
        records = list(reader.records())
    assert reader.damage.whole and reader.notes == ()
    assert reader.damage.n_read == sum(COUNTS.values())
    for topic, n in COUNTS.items():
        mine = [r for r in records if r.stream == topic]
        assert len(mine) == n
        assert (np.diff([r.received_ns for r in mine]) > 0).all()
        assert all(r.published_ns == r.received_ns for r in mine)


def test_pictures_come_after_their_messages_with_their_stamps(whole):
    before = None
    with open_recording(whole) as reader:
        for record in reader.records(streams=[INFO, IMAGE]):
            if record.stream == IMAGE:
                assert record.received_ns == before.received_ns
                assert (record.value.time_ns, record.value.number) == (
                    before.value.time_ns,
                    before.value.number,
                )
            before = record
        assert numbers(reader) == list(range(120))
        assert {r.kind for r in reader.records(kinds=["imu"])} == {"imu"}


def test_pictures_that_are_missing_are_found_by_time(tmp_path):
    """Not by order: the pictures behind the missing ones keep their messages."""
    missing = (7, 8, 80)
    path = write_folder(tmp_path / "rig", Faults(unfilmed=missing), seconds=4.0, segment_s=2.0)
    with RigReader(path) as reader:
        assert {s.name: s.count for s in reader.streams}[IMAGE] == 117
        assert numbers(reader) == [n for n in range(120) if n not in missing]
        assert reader.damage.n_lost == 3
        assert "cam1-0000.mkv: 2 messages have no picture" in reader.damage.places
        assert len(reader.picture_stamps(IMAGE)) == 117


def test_any_part_of_the_pictures_across_segments(whole):
    with RigReader(whole) as reader:
        assert [shown(p) for p in reader.pictures(IMAGE, range(55, 65))] == [n % 16 for n in range(55, 65)]
        assert reader.single_video(IMAGE) is None


def test_without_its_manifest(whole, folder):
    (folder / MANIFEST).unlink()
    with open_recording(folder) as reader:
        assert {s.name: s.count for s in reader.streams} == COUNTS
        assert reader.manifest is None and "cannot be read" in reader.notes[0]
    (folder / MANIFEST).write_text("{not json")
    with open_recording(folder) as reader:
        assert len(list(reader.records(kinds=["lidar"]))) == 40
        assert "damaged" in reader.notes[0]
    text = (whole / MANIFEST).read_text()
    (folder / MANIFEST).write_text(text.replace("rig-recording/1", "rig-recording/2"))
    with open_recording(folder) as reader:
        assert "another version" in reader.notes[0]


def test_a_cut_segment_gives_what_is_whole_and_the_others_all(folder):
    file = folder / "messages-0000.mcap"
    file.write_bytes(file.read_bytes()[:30_000])
    with open_recording(folder) as reader:
        records = list(reader.records(kinds=["imu"]))
        assert 200 < len(records) < 400
        assert not reader.damage.whole
        assert any("messages-0000.mcap" in place and "cut" in place for place in reader.damage.places)
        kept = numbers(reader)
    assert set(range(60, 120)) <= set(kept) and len(kept) < 120


@pytest.mark.parametrize("name", ["messages-0001.mcap", "cam1-0001.mkv"])
@pytest.mark.parametrize("how", ["gone", "empty"])
def test_a_lost_file_is_told(folder, name, how):
    (folder / name).write_bytes(b"")
    if how == "gone":
        (folder / name).unlink()
    with open_recording(folder) as reader:
        kept = numbers(reader)
        assert any(name in place for place in reader.damage.places)
    assert kept == list(range(60))


def test_a_cut_video_keeps_its_first_pictures(folder):
    file = folder / "cam1-0001.mkv"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with open_recording(folder) as reader:
        kept = numbers(reader)
        assert reader.damage.n_lost == 120 - len(kept)
    assert 60 < len(kept) < 120 and kept == list(range(len(kept)))


def test_an_import_takes_the_pictures_of_the_folder(whole):
    scan = scan_recording(whole)
    assert scan.streams[IMAGE].n_values == 120 and len(scan.streams[INFO].encoders) == 120
    pictures = MessagePictures(whole, IMAGE, 120, 120)
    assert len(pictures) == 120 and pictures.stamps_ns is None
    parts = [Picture(0, pixels) for pixels in pictures.frames(58, 63)]
    assert [shown(p) for p in parts] == [n % 16 for n in range(58, 63)]


def test_no_folder_of_the_recorder(tmp_path):
    with pytest.raises(InputError, match="empty"):
        open_recording(tmp_path)
    (tmp_path / "notes.txt").write_text("lunch")
    with pytest.raises(InputError, match="no recording"):
        open_recording(tmp_path)
    with pytest.raises(InputError, match="no recording of the rig"):
        RigReader(tmp_path)


def test_import_recording_makes_a_sequence_of_it(whole, tmp_path):
    """The command, from the recorder's folder to a sequence, without ``--video``."""
    from acino_fte.cameras import Camera
    from acino_fte.cli import app
    from acino_fte.data_tools.lidar_camera import LidarCamera, write_lidar_camera
    from acino_fte.data_tools.video import VideoReader

    turn = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    matrix = [[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]
    camera = Camera("cam1", "pinhole", matrix, [], turn, np.zeros(3), (64, 48))
    write_lidar_camera(tmp_path / "calibration.json", LidarCamera(camera))
    out = tmp_path / "out"
    arguments = ["import-recording", str(whole), "-o", str(out), "--motion", "none", "--pivot", "0=0.0"]
    found = CliRunner().invoke(app, [*arguments, "--calibration", str(tmp_path / "calibration.json")])
    assert found.exit_code == 0, found.output
    with VideoReader(out / "cam1.mp4") as video:
        assert len(video) == 120
        assert [shown(video.at(n)) for n in (0, 59, 60, 119)] == [n % 16 for n in (0, 59, 60, 119)]
    assert read_manifest(whole).started_ns == START
