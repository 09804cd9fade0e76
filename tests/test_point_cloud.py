"""Point clouds: PLY as others write it, as we write it, and every message."""

from pathlib import Path

import numpy as np
import pytest
from data_tools_synthetic import message
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

from acino_fte.data_tools.point_cloud import PointCloud, read_ply, write_ply
from acino_fte.data_tools.similarity import Similarity
from acino_fte.errors import InputError

NAMES = ("red", "green", "blue")
NORMALS = ("nx", "ny", "nz")


def cloud(n=20, seed=0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(0, 3, (n, 3)).astype(np.float32).astype(float), rng.integers(0, 256, (n, 3)).astype(
        np.uint8
    )


def others(path: Path, xyz, text=False, order="<", position="f4", **columns) -> Path:
    """A file as another program would write it, by plyfile."""
    kinds = [(axis, position) for axis in "xyz"] + [(name, v.dtype.str[1:]) for name, v in columns.items()]
    table = np.empty(len(xyz), kinds)
    for i, axis in enumerate("xyz"):
        table[axis] = xyz[:, i]
    for name, values in columns.items():
        table[name] = values
    PlyData([PlyElement.describe(table, "vertex")], text=text, byte_order=order).write(str(path))
    return path


def test_what_is_written_is_read(tmp_path):
    xyz, rgb = cloud()
    write_ply(tmp_path / "c.ply", xyz, rgb)
    read = read_ply(tmp_path / "c.ply")
    np.testing.assert_array_equal(read.xyz, xyz)
    np.testing.assert_array_equal(read.rgb, rgb)
    assert read.xyz.dtype == float and read.rgb.dtype == np.uint8 and read.n_dropped == 0 and len(read) == 20
    write_ply(tmp_path / "c.ply", xyz)
    assert read_ply(tmp_path / "c.ply").rgb is None


def test_what_others_read(tmp_path):
    xyz, rgb = cloud(5)
    extra = {
        "individual": np.arange(5),
        "error": np.linspace(0, 1, 5),
        "kept": np.array([True, False] * 2 + [True]),
    }
    write_ply(tmp_path / "c.ply", xyz, rgb, extra, edges=np.array([[0, 1], [1, 4]]))
    assert (tmp_path / "c.ply").read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\n")
    read = PlyData.read(str(tmp_path / "c.ply"))
    kinds = {p.name: p.val_dtype for p in read["vertex"].properties}
    assert kinds == dict.fromkeys("xyz", "f4") | dict.fromkeys(NAMES, "u1") | {
        "individual": "i4",
        "error": "f4",
        "kept": "i4",
    }
    np.testing.assert_array_equal(read["vertex"]["individual"], range(5))
    np.testing.assert_allclose(read["vertex"]["error"], np.linspace(0, 1, 5), rtol=1e-6)
    np.testing.assert_array_equal(read["edge"]["vertex1"], [0, 1])
    np.testing.assert_array_equal(read["edge"]["vertex2"], [1, 4])


def test_the_same_points_make_the_same_bytes(tmp_path):
    for name in ("a.ply", "b.ply"):
        write_ply(tmp_path / name, *cloud())
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_nothing_is_a_file_too(tmp_path):
    """Tracks without points are written; to read, an empty cloud is a mistake."""
    write_ply(tmp_path / "c.ply", np.zeros((0, 3)), np.zeros((0, 3)), {"frame": np.zeros(0, dtype=int)})
    assert PlyData.read(str(tmp_path / "c.ply"))["vertex"].count == 0
    assert "empty" in message(read_ply, tmp_path / "c.ply").problem


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("position", ["f4", "f8"])
def test_all_kinds_of_ply(tmp_path, text, order, position):
    """With normals between, as COLMAP's fused.ply has them."""
    xyz, rgb = cloud()
    normals = dict(zip(NORMALS, np.eye(3, dtype=np.float32)[np.arange(20) % 3].T, strict=True))
    colours = dict(zip(NAMES, rgb.T, strict=True))
    read = read_ply(others(tmp_path / "c.ply", xyz, text, order, position, **normals, **colours))
    np.testing.assert_allclose(read.xyz, xyz, rtol=1e-6)
    np.testing.assert_array_equal(read.rgb, rgb)


@pytest.mark.parametrize("names", [NAMES, [f"diffuse_{n}" for n in NAMES], ["r", "g", "b"]])
def test_names_of_colours(tmp_path, names):
    xyz, rgb = cloud()
    read = read_ply(others(tmp_path / "c.ply", xyz, **dict(zip(names, rgb.T, strict=True))))
    np.testing.assert_array_equal(read.rgb, rgb)


@pytest.mark.parametrize(
    "scaled", [lambda c: (c / 255).astype(np.float32), lambda c: c.astype(np.uint16) * 257]
)
def test_other_kinds_of_colours(tmp_path, scaled):
    xyz, rgb = cloud()
    read = read_ply(others(tmp_path / "c.ply", xyz, **dict(zip(NAMES, scaled(rgb).T, strict=True))))
    np.testing.assert_array_equal(read.rgb, rgb)


def test_corners_of_a_mesh(tmp_path):
    lines = ["ply", "format ascii 1.0", "comment made by hand", "element vertex 3"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    (tmp_path / "m.ply").write_text("\n".join([*lines, "0 0 0", "1 0 0", "0 2 0", "3 0 1 2"]) + "\n")
    np.testing.assert_array_equal(read_ply(tmp_path / "m.ply").xyz, [[0, 0, 0], [1, 0, 0], [0, 2, 0]])


def test_rows_that_are_not_finite_are_dropped_and_counted(tmp_path):
    xyz, rgb = cloud()
    xyz[3, 1], xyz[7] = np.nan, np.inf
    read = read_ply(others(tmp_path / "c.ply", xyz, **dict(zip(NAMES, rgb.T, strict=True))))
    kept = np.isfinite(xyz).all(1)
    assert read.n_dropped == 2
    np.testing.assert_allclose(read.xyz, xyz[kept], rtol=1e-6)
    np.testing.assert_array_equal(read.rgb, rgb[kept])
    message(read_ply, others(tmp_path / "d.ply", np.full((4, 3), np.nan)))


def test_a_moved_cloud():
    xyz, rgb = cloud()
    error = np.arange(20.0)
    change = Similarity(2.0, Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix(), np.array([1.0, 2.0, 3.0]))
    moved = PointCloud(xyz, rgb, error).moved(change)
    np.testing.assert_allclose(moved.xyz, change.points(xyz))
    assert moved.rgb is rgb and moved.error is error


# ---------------------------------------------------------------------------------- bad files


def test_files_that_cannot_be_read(tmp_path):
    assert message(read_ply, tmp_path / "none.ply").found == "nothing"
    assert message(read_ply, tmp_path).found == "a folder"
    path = tmp_path / "c.ply"
    for content in (
        b"",
        b"hello",
        b"ply\n",
        b"ply\nformat ascii 1.0\nelement vertex x\nend_header\n",
        b"\xff\xfe\x00",
    ):
        path.write_bytes(content)
        assert message(read_ply, path).file == str(path)


@pytest.mark.parametrize("text", [True, False])
def test_files_that_end_too_early(tmp_path, text):
    path = others(tmp_path / "c.ply", *cloud()[:1], text)
    data = path.read_bytes()
    for length in (len(data) - (20 if text else 1), len(data) // 2, 30):
        path.write_bytes(data[:length])
        assert "cannot be read" in message(read_ply, path).problem


def test_a_count_that_no_machine_holds(tmp_path):
    path = others(tmp_path / "c.ply", cloud()[0])
    path.write_bytes(path.read_bytes().replace(b"vertex 20", b"vertex 20000000000000"))
    message(read_ply, path)


def test_files_without_points(tmp_path):
    table = np.zeros(2, [("a", "f4")])
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "a.ply"))
    assert "no positions" in message(read_ply, tmp_path / "a.ply").problem
    PlyData([PlyElement.describe(table, "face")]).write(str(tmp_path / "b.ply"))
    assert "no vertices" in message(read_ply, tmp_path / "b.ply").problem
    lists = np.empty(1, [("x", "O"), ("y", "f4"), ("z", "f4")])
    lists["x"][0] = np.array([1.0, 2.0], dtype="f4")
    PlyData([PlyElement.describe(lists, "vertex", {"x": "u1"}, {"x": "f4"})]).write(str(tmp_path / "c.ply"))
    message(read_ply, tmp_path / "c.ply")


@pytest.mark.parametrize(
    "wrong",
    [
        {"rgb": np.zeros((3, 3))},
        {"extra": {"a": np.zeros(3)}},
        {"extra": {"red": np.zeros(20)}},
        {"extra": {"two words": np.zeros(20)}},
        {"edges": np.array([[0, 20]])},
        {"edges": np.array([[-1, 2]])},
    ],
)
def test_what_cannot_be_written(tmp_path, wrong):
    with pytest.raises(InputError):
        write_ply(tmp_path / "c.ply", cloud()[0], **wrong)
    assert not (tmp_path / "c.ply").exists()


def test_a_place_that_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        write_ply(tmp_path / "nowhere" / "c.ply", cloud()[0])
