"""Tables of inertial samples, and body-worn sensors against their own orientation."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from acino_fte.data_tools.imu import gyro_attitude
from acino_fte.data_tools.imu_filter import gravity_attitude
from acino_fte.data_tools.imu_table import read_imu_table
from acino_fte.data_tools.recording import GRAVITY
from acino_fte.errors import InputError

BODY = Path(__file__).resolve().parents[2] / "shared" / "data" / "imu_body"
needs_body = pytest.mark.skipif(not BODY.is_dir(), reason="the body-worn recordings (imu_body) are not here")


def write(tmp_path, text, name="imu.csv"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_units_in_the_header(tmp_path):
    path = write(
        tmp_path,
        "Timestamp (us),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),"
        "Accelerometer X (g),Accelerometer Y (g),Accelerometer Z (g)\n"
        "1000,180,0,0,0,0,1\n3000,0,90,,0,0,1\n5000,0,0,45,0,0.5,1\n",
    )
    samples = read_imu_table(path)
    np.testing.assert_array_equal(samples.time_ns, [1_000_000, 3_000_000, 5_000_000])
    np.testing.assert_allclose(samples.rate[[0, 2]], [[np.pi, 0, 0], [0, 0, np.pi / 4]])
    assert np.isnan(samples.rate[1, 2])
    np.testing.assert_allclose(samples.force[2], [0, 0.5 * GRAVITY, GRAVITY])


def test_stated_columns_and_rate(tmp_path):
    path = write(tmp_path, "// Sample rate: 50.0Hz\n p;q;r;u;v;w\n1;2;3;4;5;6\n1;2;3;4;5;6\n")
    columns = {"rate": ("p", "q", "r"), "force": ("u", "v", "w")}
    samples = read_imu_table(path, columns=columns, rate_unit="rad/s", force_unit="m/s2")
    np.testing.assert_array_equal(samples.time_ns, [0, 20_000_000])
    np.testing.assert_array_equal(samples.rate[0], [1, 2, 3])
    np.testing.assert_array_equal(samples.force[1], [4, 5, 6])


NAMES = "time (s),gyr_x,gyr_y,gyr_z,acc_x,acc_y,acc_z\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (NAMES + "0,0,0,0,0,0,1\n1,0,0,0,0,0,1\n", "unit of the rate"),
        ("a,b\n1,2\n", "lacks columns"),
        (NAMES, "empty"),
        ("", "empty"),
        (NAMES.replace("time (s),", "").replace("gyr", "gyro") + "0,0,0,0,0,1\n" * 2, "sample rate"),
        (NAMES + "0,0,x,0,0,0,1\n1,0,0,0,0,0,1\n", "no number"),
        (NAMES + ",0,0,0,0,0,1\n1,0,0,0,0,0,1\n", "no time"),
        (NAMES + "1e30,0,0,0,0,0,1\n1,0,0,0,0,0,1\n", "no time that can be"),
        (NAMES.replace("gyr_y", "gyr_x") + "0,0,0,0,0,0,1\n" * 2, "there twice"),
        (NAMES.replace("gyr_y", "gyro_x") + "0,0,0,0,0,0,1\n" * 2, "lacks columns of the rate"),
        (NAMES.replace("time (s)", "gyro_x") + "0,0,0,0,0,0,1\n" * 2, "too many columns of the rate"),
        (NAMES.replace("gyr_y", "gyr_y (deg/h)") + "0,0,0,0,0,0,1\n" * 2, "unit of the rate"),
    ],
)
def test_faults(tmp_path, text, message):
    units = {} if message.endswith("of the rate") else {"rate_unit": "rad/s", "force_unit": "g"}
    with pytest.raises(InputError, match=message):
        read_imu_table(write(tmp_path, text), **units)


def test_a_missing_file(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_imu_table(tmp_path / "no.csv")
    (tmp_path / "latin.csv").write_bytes("größe;b\n1;2\n".encode("latin-1"))
    with pytest.raises(InputError, match="UTF-8"):
        read_imu_table(tmp_path / "latin.csv")


def test_a_cut_last_line(tmp_path):
    path = write(tmp_path, NAMES + "0,0,0,0,0,0,1\n1,0,0,0,0,0,1\n2,0,0,0.1,0,-")
    samples = read_imu_table(path, rate_unit="rad/s", force_unit="g")
    assert len(samples) == 3 and np.isnan(samples.force[2]).any()


def xsens():
    samples = read_imu_table(BODY / "xsens.txt", rate_unit="rad/s", force_unit="m/s2")
    rows = [line.split() for line in (BODY / "xsens.txt").read_text().splitlines()[5:]]
    return samples, np.array([r[10:14] for r in rows], dtype=float)


def xio3():
    reference = np.loadtxt(BODY / "xio3_quaternion.csv", delimiter=",", skiprows=1)
    return read_imu_table(BODY / "xio3_inertial.csv"), reference[:, 1:]


def errors(found, reference):
    """Degrees from the sensor's own orientation, after the heading at the start was made the same."""
    apart = reference[0] @ found[0].T
    heading = np.arctan2(apart[1, 0] - apart[0, 1], apart[0, 0] + apart[1, 1])
    aligned = Rotation.from_rotvec([0, 0, heading]).as_matrix() @ found
    return np.degrees(Rotation.from_matrix(reference @ np.swapaxes(aligned, 1, 2)).magnitude())


@needs_body
@pytest.mark.parametrize(("read", "turned"), [(xsens, 998.5), (xio3, 1795.0)])
def test_body_worn_sensors_without_a_magnetometer(read, turned):
    """At the end of a recording, five degrees at most: of the rates alone, and with gravity."""
    samples, quaternion = read()
    reference = Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_matrix()
    step = np.diff(samples.time_ns) * 1e-9
    total = np.degrees((np.linalg.norm(samples.rate[1:], axis=1) * step).sum())
    assert total == pytest.approx(turned, rel=0.01)
    for method in ("simpson", "mean"):
        alone = gyro_attitude(samples, start=reference[0], method=method)
        helped = gravity_attitude(samples, method=method)
        for found in (alone, helped):
            error = errors(found.rotation, reference)
            assert error[-1] <= 5.0 and np.median(error) <= 5.0
            assert error[-1] < 3 * np.degrees(np.sqrt(np.trace(found.covariance[-1])))


@needs_body
def test_both_sensors_give_means_over_their_steps():
    """Their own orientation is half a step ahead of momentary rates: it follows rates that are means."""
    for read in (xsens, xio3):
        samples, quaternion = read()
        reference = Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_matrix()
        worst = {
            m: errors(gyro_attitude(samples, start=reference[0], method=m).rotation, reference).max()
            for m in ("simpson", "mean")
        }
        assert worst["mean"] < 0.85 * worst["simpson"]
        levelled = gravity_attitude(samples, method="mean").rotation
        helped = errors(levelled, reference)
        up = np.degrees(np.arccos(np.clip((levelled[:, 2] * reference[:, 2]).sum(1), -1, 1)))
        # of xio3 it is the reference's heading that goes away and comes back: docs/camera_motion.md
        assert up.max() <= (3.5 if read is xsens else 1.2)
        assert (helped <= 5.0).mean() >= (1.0 if read is xsens else 0.85)
        if read is xsens:
            assert worst["mean"] <= 5.0  # throughout, not only at the end
