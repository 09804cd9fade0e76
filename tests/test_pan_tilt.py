"""Encoders of a pan-tilt head: angles, poses, levers, times, faults."""

import numpy as np
import pytest

from acino_fte.cameras import Camera
from acino_fte.data_tools.camera_motion import camera_with_motion
from acino_fte.data_tools.pan_tilt import PanTiltHead, motion_from_encoders, read_encoder_table
from acino_fte.errors import InputError

HEAD = PanTiltHead((4096, 8192), zero=(100, 50))


def counts(pan, tilt, head=HEAD):
    """Counts of angles in degrees."""
    angle = np.stack(np.broadcast_arrays(pan, tilt), axis=-1).astype(float)
    return angle * head.sign * head.counts_per_turn / 360 + head.zero


@pytest.mark.parametrize(
    ("pan", "tilt", "right", "forward"),
    [
        (0, 0, [0, -1, 0], [1, 0, 0]),
        (90, 0, [1, 0, 0], [0, 1, 0]),  # to the left
        (0, 30, [0, -1, 0], [np.cos(np.pi / 6), 0, 0.5]),  # upwards
        (90, 30, [1, 0, 0], [0, np.cos(np.pi / 6), 0.5]),  # the tilt axis goes with the pan
    ],
)
def test_where_the_camera_looks(pan, tilt, right, forward):
    motion = motion_from_encoders(counts([pan], [tilt]), HEAD)
    np.testing.assert_allclose(motion.rotation[0][0], right, atol=1e-12)
    np.testing.assert_allclose(motion.rotation[0][2], forward, atol=1e-12)
    assert motion.levelled and motion.scale_known and motion.known.all()


def test_signs_zeros_and_a_counter_that_wraps():
    head = PanTiltHead((4096, 8192), zero=(100, 50), sign=(-1, 1))
    np.testing.assert_allclose(np.degrees(head.angles(counts([10, 20], [1, 2], head))), [[10, 1], [20, 2]])
    wrapped = np.mod(counts(np.arange(0, 400, 20), 0.0), 4096)
    angles = HEAD.angles(np.column_stack([wrapped[:, 0], np.full(20, 50)]))
    np.testing.assert_allclose(np.degrees(np.diff(angles[:, 0])), 20, atol=1e-9)


def test_the_lever_goes_with_pan_and_tilt():
    head = PanTiltHead((4096, 4096), tilt_axis=np.array([0.1, 0, 0.2]), lever=np.array([0.3, 0, 0.05]))
    motion = motion_from_encoders(counts([0, 90, 0], [0, 0, 90], head), head)
    np.testing.assert_allclose(motion.centre[1], [-0.4, 0.4, 0], atol=1e-12)
    np.testing.assert_allclose(motion.centre[2], [0.1 - 0.05 - 0.4, 0, 0.3 + 0.2 - 0.25], atol=1e-12)


def test_interpolated_at_the_frames():
    time = np.arange(0, 1, 0.05)
    motion = motion_from_encoders(
        counts(40 * time, 10 * time), HEAD, time=time, frame_time=np.array([-0.1, 0.0, 0.333, 0.9, 1.2])
    )
    np.testing.assert_array_equal(motion.known, [False, True, True, True, False])
    assert motion.numbers["pan_deg"][2] == pytest.approx(40 * 0.333)
    np.testing.assert_allclose(motion.rotation[0], motion.rotation[1])
    assert np.isnan(motion.rotation_sd[0]) and "2 of 5" in motion.notes[0]


def test_gaps_and_missing_counts_are_bridged():
    time = np.delete(np.arange(0, 2, 0.05), slice(10, 30))
    frames = np.array([0.2, 1.0, 1.6])
    motion = motion_from_encoders(counts(30 * time, 0 * time), HEAD, time=time, frame_time=frames)
    np.testing.assert_array_equal(motion.known, [True, False, True])
    table = counts([0.0, 10.0, 20.0], 0.0)
    table[1, 1] = np.nan
    motion = motion_from_encoders(table, HEAD)
    assert not motion.known[1] and np.degrees(motion.turned[1]) == pytest.approx(
        np.degrees(motion.turned[2]) / 2
    )


def test_the_error_of_rounded_counts_is_what_it_says():
    rng = np.random.default_rng(0)
    pan, tilt = rng.uniform(-60, 60, 2000), rng.uniform(-20, 20, 2000)
    head = PanTiltHead((720, 720))
    true = motion_from_encoders(counts(pan, tilt, head), head)
    found = motion_from_encoders(np.round(counts(pan, tilt, head)), head)
    trace = np.trace(true.rotation @ np.swapaxes(found.rotation, 1, 2), axis1=1, axis2=2)
    rms = np.sqrt(np.mean(2 * (3 - trace) / 2 / 3))  # per axis, for small angles
    assert rms == pytest.approx(found.rotation_sd[0], rel=0.1)


def test_into_a_camera():
    lens = Camera("c", "pinhole", np.diag([800.0, 800, 1]), np.zeros(0), np.eye(3), np.zeros(3), (640, 480))
    motion = motion_from_encoders(counts([0, 10], [0, 0]), HEAD)
    camera = camera_with_motion(lens, motion)
    pixels = camera.project(np.tile([[10.0, 0, 0]], (2, 1, 1)))[:, 0]
    np.testing.assert_allclose(pixels, [[0, 0], [800 * np.tan(np.radians(10)), 0]], atol=1e-9)
    kept = camera_with_motion(lens, motion, anchor="camera")
    np.testing.assert_allclose(kept.rotation[0], np.eye(3), atol=1e-12)


def test_tables(tmp_path):
    path = tmp_path / "e.csv"
    path.write_text("time (s), Pan, Tilt\n0.0,100,50\n0.1,110,\n")
    table, time, frame = read_encoder_table(path)
    np.testing.assert_array_equal(time, [0, 0.1])
    assert frame is None and np.isnan(table[1, 1]) and table[1, 0] == 110
    path.write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="lacks columns"):
        read_encoder_table(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_encoder_table(tmp_path / "no.csv")
    for frames in ("0.5", "nan", "1e300"):
        path.write_text(f"pan,tilt,frame\n1,2,0\n1,2,{frames}\n")
        with pytest.raises(InputError, match="frames of the encoders"):
            read_encoder_table(path)
    path.write_text("")
    with pytest.raises(InputError, match="empty"):
        read_encoder_table(path)


def test_faults():
    with pytest.raises(InputError, match="counts per turn"):
        PanTiltHead((0, 4096))
    with pytest.raises(InputError, match="zero of the encoders"):
        PanTiltHead((4096, 4096), zero=(np.nan, 0))
    with pytest.raises(InputError, match="directions"):
        PanTiltHead((4096, 4096), sign=(2, 1))
    with pytest.raises(InputError, match="shape"):
        motion_from_encoders(np.zeros((3, 3)), HEAD)
    with pytest.raises(InputError, match="No frame"):
        motion_from_encoders(np.full((3, 2), np.nan), HEAD)
    with pytest.raises(InputError, match="grow"):
        motion_from_encoders(np.zeros((3, 2)), HEAD, time=np.array([0, 2, 1.0]), frame_time=np.zeros(1))
