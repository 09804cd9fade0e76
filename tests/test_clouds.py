"""Point clouds of lidars: what we and others write is read, cut files give whole points, bad ones say why."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from data_tools_synthetic import message
from hypothesis import given
from hypothesis import strategies as st

from acino_fte.cameras import Camera
from acino_fte.data_tools.clouds import LidarCloud, read_cloud, write_cloud
from acino_fte.data_tools.clouds_pcd import lzf_prefix
from acino_fte.data_tools.point_cloud import read_ply
from acino_fte.errors import InputError

KITTI = Path(__file__).resolve().parents[2] / "shared" / "data" / "lidar_rgb_kitti"
WAYS = [
    ("pcd", "ascii"),
    ("pcd", "binary"),
    ("pcd", "binary_compressed"),
    ("ply", "ascii"),
    ("ply", "binary"),
]


def cloud(n=200, seed=0, **changes) -> LidarCloud:
    """Points of single precision, as the files hold them; neighbours are alike, so that packing pays."""
    rng = np.random.default_rng(seed)
    xyz = np.round(np.cumsum(rng.normal(0, 0.1, (n, 3)), axis=0), 1).astype(np.float32).astype(float)
    values = {
        "intensity": rng.integers(0, 256, n).astype(float),
        "rgb": rng.integers(0, 256, (n, 3)).astype(np.uint8),
        "time": 12.5 + np.arange(n) * 4.167e-6,
    }
    return LidarCloud(xyz, **(values | changes))


def assert_same(read: LidarCloud, true: LidarCloud, n: int | None = None) -> None:
    """The first `n` points, to the digits of text."""
    np.testing.assert_allclose(read.xyz, true.xyz[:n], atol=1e-6)
    np.testing.assert_array_equal(read.intensity, true.intensity[:n])
    np.testing.assert_array_equal(read.rgb, true.rgb[:n])
    np.testing.assert_allclose(read.time, true.time[:n], atol=1e-9)


# ---------------------------------------------------------------------------------- whole files


@pytest.mark.parametrize(("suffix", "way"), WAYS)
def test_what_is_written_is_read(tmp_path, suffix, way):
    write_cloud(tmp_path / f"c.{suffix}", cloud(), encoding=way)
    read = read_cloud(tmp_path / f"c.{suffix}")
    assert_same(read, cloud())
    assert (read.n_lost, read.n_dropped, read.notes, len(read)) == (0, 0, (), 200)
    assert [path.name for path in tmp_path.iterdir()] == [f"c.{suffix}"]


@pytest.mark.parametrize("way", ["ascii", "binary", "binary_compressed"])
def test_pcd_of_pypcd4_and_back(tmp_path, way):
    """Theirs is read, ours is read by theirs."""
    from pypcd4 import Encoding, PointCloud

    true = cloud()
    columns = (*true.xyz.T.astype(np.float32), true.intensity.astype(np.float32))
    theirs = PointCloud.from_points(columns, ("x", "y", "z", "intensity"), (np.float32,) * 4)
    theirs.save(tmp_path / "theirs.pcd", Encoding(way))
    read = read_cloud(tmp_path / "theirs.pcd")
    np.testing.assert_allclose(read.xyz, true.xyz, atol=1e-6)
    np.testing.assert_array_equal(read.intensity, true.intensity)
    assert read.rgb is None and read.time is None
    write_cloud(tmp_path / "ours.pcd", true, encoding=way)
    back = PointCloud.from_path(tmp_path / "ours.pcd")
    assert back.metadata.data.value == way
    np.testing.assert_allclose(back.numpy(("x", "y", "z")), true.xyz, atol=1e-6)


def test_ply_is_read_by_our_other_reader(tmp_path):
    write_cloud(tmp_path / "c.ply", cloud())
    other = read_ply(tmp_path / "c.ply")
    np.testing.assert_array_equal(other.xyz, cloud().xyz)
    np.testing.assert_array_equal(other.rgb, cloud().rgb)


def test_pcd_by_hand(tmp_path):
    """Fields of several numbers, padding, packed colours as a float, times in ns, comments, no POINTS."""
    (tmp_path / "c.pcd").write_text(
        "# .PCD v.7 - Point Cloud Data file format\nVERSION .7\nFIELDS x y z normal _ rgb t\n"
        "SIZE 4 4 4 4 1 4 8\nTYPE F F F F U F U\nCOUNT 1 1 1 3 2 1 1\nWIDTH 2\nHEIGHT 1\n"
        "VIEWPOINT 0 0 0 1 0 0 0\nDATA ascii\n"
        f"1 2 3 0 0 1 9 9 {np.uint32(0x00FF8001).view(np.float32):.9g} 1700000000000000001\n"
        "nan 2 3 0 0 1 9 9 0 5\n"
    )
    read = read_cloud(tmp_path / "c.pcd")
    np.testing.assert_array_equal(read.xyz, [[1, 2, 3]])
    np.testing.assert_array_equal(read.rgb, [[255, 128, 1]])
    assert read.time[0] == pytest.approx(1.7e9) and read.n_dropped == 1 and read.intensity is None


def test_kitti_numpy_and_text(tmp_path):
    true = cloud()
    table = np.c_[true.xyz, true.intensity].astype(np.float32)
    table.tofile(tmp_path / "a.bin")
    np.save(tmp_path / "b.npy", table)
    np.savez(tmp_path / "c.npz", xyz=true.xyz, intensity=true.intensity, time=true.time, rgb=true.rgb)
    for name, mark in {"d.csv": ",", "e.txt": " ", "f.csv": ";"}.items():
        np.savetxt(
            tmp_path / name, table, "%.9g", delimiter=mark, header=f"X{mark}Y{mark}Z{mark}Reflectivity"
        )
    np.savetxt(tmp_path / "g.xyz", table, "%.9g")
    for path in sorted(tmp_path.iterdir()):
        read = read_cloud(path)
        np.testing.assert_allclose(read.xyz, true.xyz, atol=1e-6, err_msg=path.name)
        np.testing.assert_array_equal(read.intensity, true.intensity)
        assert read.n_lost == 0 and bool(read.notes) == (path.name == "g.xyz")
    assert_same(read_cloud(tmp_path / "c.npz"), true)


def test_livox_viewers_table(tmp_path):
    """Spaces in names, ns in whole numbers, empty cells."""
    (tmp_path / "c.csv").write_text(
        "Version,Slot ID,Timestamp,X,Y,Z,Reflectivity,Tag\n"
        "5,1,1500000000,1.5,2,-3,17,0\n5,1,1500004167,4,5,6,,0\n5,1,15,x,5,6,3,0\n"
    )
    read = read_cloud(tmp_path / "c.csv")
    np.testing.assert_array_equal(read.xyz, [[1.5, 2, -3], [4, 5, 6]])
    np.testing.assert_allclose(read.time, [1.5, 1.500004167], rtol=1e-12)
    assert read.intensity[0] == 17 and np.isnan(read.intensity[1]) and read.n_lost == 1


def test_positions_that_are_not_finite_are_dropped_and_counted(tmp_path):
    true = cloud(10)
    xyz = true.xyz.copy()
    xyz[3, 1], xyz[7] = np.nan, np.inf
    write_cloud(tmp_path / "c.pcd", LidarCloud(xyz, true.intensity))
    read = read_cloud(tmp_path / "c.pcd")
    assert read.n_dropped == 2
    np.testing.assert_array_equal(read.intensity, np.delete(true.intensity, [3, 7]))


# ---------------------------------------------------------------------------------- damaged files


@pytest.mark.parametrize("suffix", ["pcd", "ply"])
@pytest.mark.parametrize("way", ["ascii", "binary"])
def test_cut_bodies_give_their_whole_rows(tmp_path, suffix, way):
    """At every tenth of the body: all rows before the cut, and the count of the others."""
    path = tmp_path / f"c.{suffix}"
    write_cloud(path, cloud(60), encoding=way)
    data = path.read_bytes()
    start = data.index(b"\n", data.index(b"DATA" if suffix == "pcd" else b"end_header")) + 1
    row = (len(data) - start) // 60
    lines = [len(line) for line in data[start:].splitlines(keepends=True)]
    for tenth in range(1, 10):
        stop = start + (len(data) - start) * tenth // 10 + 1
        path.write_bytes(data[:stop])
        read = read_cloud(path)
        whole = (stop - start) // row if way == "binary" else int((np.cumsum(lines) <= stop - start).sum())
        assert len(read) in ((whole,) if way == "binary" else (whole, whole + 1))  # a number cut short is one
        assert len(read) + read.n_lost == 60
        assert_same(read_cloud(path), cloud(60), len(read)) if way == "binary" else None


def test_a_cut_packed_pcd(tmp_path):
    """Fields lie one after the other: a cut in the last leaves the positions, a cut in z loses points."""
    path = tmp_path / "c.pcd"
    true = cloud(400)
    write_cloud(path, true, encoding="binary_compressed")
    data = path.read_bytes()
    path.write_bytes(data[:-200])
    read = read_cloud(path)
    np.testing.assert_array_equal(read.xyz, true.xyz)
    assert read.rgb is None and "rgba" in read.notes[0]
    seen = set()
    for length in range(len(data) - 201, 300, -97):
        path.write_bytes(data[:length])
        try:
            read = read_cloud(path)
        except InputError:
            seen.add(0)
            continue
        np.testing.assert_array_equal(read.xyz, true.xyz[: len(read)])
        assert len(read) + read.n_lost == 400
        seen.add(len(read))
    assert 0 in seen and 400 in seen and len(seen) > 3


@given(st.binary(max_size=300).map(lambda part: part * 3))
def test_lzf_against_the_library(plain):
    import lzf

    packed = lzf.compress(plain) if plain else None
    if packed:
        assert lzf_prefix(packed, len(plain)) == plain
        assert plain.startswith(lzf_prefix(packed[: len(packed) // 2], len(plain)))


def test_damage_in_text(tmp_path):
    write_cloud(tmp_path / "c.pcd", cloud(20), encoding="ascii")
    lines = (tmp_path / "c.pcd").read_bytes().splitlines(keepends=True)
    lines[15], lines[18] = b"1 2 three 4 5 6\n", b"\0\0\0\xff garbage\n"
    (tmp_path / "c.pcd").write_bytes(b"".join(lines))
    read = read_cloud(tmp_path / "c.pcd")
    kept = np.delete(
        np.arange(20), [15 - 11, 18 - 11] if lines[10].startswith(b"DATA") else [15 - 10, 18 - 10]
    )
    np.testing.assert_allclose(read.xyz, cloud(20).xyz[kept], atol=1e-6)
    assert read.n_lost == 2


def test_cut_arrays(tmp_path):
    true = cloud()
    table = np.c_[true.xyz, true.intensity].astype(np.float32)
    table.tofile(tmp_path / "a.bin")
    np.save(tmp_path / "b.npy", table)
    for name in ("a.bin", "b.npy"):
        path = tmp_path / name
        path.write_bytes(path.read_bytes()[:-21])
        read = read_cloud(path)
        np.testing.assert_array_equal(read.xyz, true.xyz[: len(read)])
        assert len(read) == 198 and read.n_lost == (1 if name == "a.bin" else 2)


@pytest.mark.parametrize("suffix", [".pcd", ".ply", ".bin", ".npy", ".npz", ".csv", ".lvx"])
def test_bytes_that_are_no_cloud(tmp_path, suffix):
    """Whatever they are: a cloud, or one message that names the file."""
    rng = np.random.default_rng(1)
    starts = [
        b"",
        b"ply\n",
        b"ply\nformat ascii 1.0\nelement vertex 3\nend_header\n",
        b"VERSION 0.7\nFIELDS x y\n",
    ]
    starts += [
        b"\x93NUMPY\x01\x00",
        b"PK\x03\x04",
        b"# .PCD v0.7\nDATA binary\n",
        b"x,y,z\n",
        b"ply\nend_header",
    ]
    starts.append(b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 9\nTYPE F F F\nCOUNT 1 1 1\nPOINTS 9\nDATA binary\n")
    for start in starts:
        for length in (0, 3, 300):
            path = tmp_path / f"c{suffix}"
            path.write_bytes(start + rng.integers(0, 256, length, dtype=np.uint8).tobytes())
            try:
                read_cloud(path)
            except InputError as error:
                assert error.file == str(path) and error.found and error.expected


def test_messages(tmp_path):
    assert message(read_cloud, tmp_path / "none.pcd").found == "nothing"
    assert message(read_cloud, tmp_path).found == "a folder"
    np.save(tmp_path / "o.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    assert "arrays" in message(read_cloud, tmp_path / "o.npy").problem
    np.savez(tmp_path / "o.npz", xyz=np.zeros((4, 3)), intensity=np.zeros(5))
    assert "(5,)" in message(read_cloud, tmp_path / "o.npz").found
    (tmp_path / "a.csv").write_text("u,v\n1,2\n")
    assert "names x, y, z" in message(read_cloud, tmp_path / "a.csv").expected
    with pytest.raises(InputError, match="another ending"):
        write_cloud(tmp_path / "c.las", cloud())
    with pytest.raises(InputError, match="differ in length"):
        write_cloud(tmp_path / "c.pcd", cloud(5, time=np.zeros(4)))
    with pytest.raises(InputError, match="cannot be written"):
        write_cloud(tmp_path / "nowhere" / "c.pcd", cloud())


# ---------------------------------------------------------------------------------- projection


@pytest.mark.skipif(not KITTI.is_dir(), reason="the real scan shared/data/lidar_rgb_kitti is absent")
def test_a_real_cloud_projects_as_opencv_projects_it():
    """To 1e-6 px: our camera, cv2.projectPoints, and the product P2 R0_rect Tr of KITTI's own notes."""
    lines = (line.split(":") for line in (KITTI / "calib.txt").read_text().splitlines() if ":" in line)
    file = {name: np.array(values.split(), dtype=float) for name, values in lines}
    projection = file["P2"].reshape(3, 4)
    rectify, move = np.eye(4), np.eye(4)
    rectify[:3, :3], move[:3] = file["R0_rect"].reshape(3, 3), file["Tr_velo_to_cam"].reshape(3, 4)
    read = read_cloud(KITTI / "velodyne.bin")
    assert len(read) > 100_000 and read.intensity.min() >= 0 and read.intensity.max() <= 1

    matrix = projection[:, :3]
    lidar_to_camera = rectify @ move
    rotation, _, across = np.linalg.svd(lidar_to_camera[:3, :3])
    rotation = (
        rotation @ across
    )  # the file keeps seven digits: no rotation to 1e-9, and Camera takes none else
    translation = lidar_to_camera[:3, 3] + np.linalg.solve(matrix, projection[:, 3])
    camera = Camera("image_2", "pinhole", matrix, np.zeros(5), rotation, translation, (1242, 375))
    ahead = read.xyz[(read.xyz @ rotation.T + translation)[:, 2] > 1.0]
    pixels = camera.project(ahead)
    direct, _ = cv2.projectPoints(ahead, cv2.Rodrigues(rotation)[0], translation, matrix, np.zeros(5))
    np.testing.assert_allclose(pixels, direct[:, 0], atol=1e-6)
    exact = np.eye(4)
    exact[:3, :3], exact[:3, 3] = rotation, translation
    homogeneous = np.c_[ahead, np.ones(len(ahead))] @ (np.c_[matrix, np.zeros(3)] @ exact).T
    np.testing.assert_allclose(pixels, homogeneous[:, :2] / homogeneous[:, 2:], atol=1e-6)
    product = np.c_[ahead, np.ones(len(ahead))] @ (projection @ lidar_to_camera).T
    inside = ((pixels >= 0) & (pixels < [1242, 375])).all(1)
    rounded = np.abs(pixels - product[:, :2] / product[:, 2:])[inside].max()
    assert rounded < 1e-3 and inside.sum() > 10_000
