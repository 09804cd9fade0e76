"""COLMAP models, read and written: pycolmap is the reference; every broken file has a clear error."""

import shutil
import struct
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from data_tools_synthetic import message
from scipy.spatial.transform import Rotation

from acino_fte.cameras import Camera
from acino_fte.data_tools.colmap import ColmapModel, read_colmap
from acino_fte.data_tools.colmap_cameras import camera_from_colmap
from acino_fte.data_tools.colmap_write import write_colmap_text
from acino_fte.data_tools.trajectory_rows import at_rows
from acino_fte.errors import InputError

pycolmap = pytest.importorskip("pycolmap")

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
LUND, KITTI = SHARED / "colmap_lund_door", SHARED / "kitti_vo"
RIGS = (SHARED / "mvt_rig", SHARED / "mvt_rig_fisheye")
ARRAYS = (
    "image_ids",
    "camera_ids",
    "rotation",
    "translation",
    "observed_image",
    "observed_point",
    "observed_xy",
)
FILES = ("cameras", "images", "points3D", "rigs", "frames")


def needs(folder: Path):
    return pytest.mark.skipif(not folder.is_dir(), reason=f"shared/data/{folder.name} is absent")


@dataclass
class Structure:
    """What a model is made of, as :func:`write_colmap_text` takes it."""

    cameras: dict
    names: list[str]
    camera_ids: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    arrays: dict = field(default_factory=dict)

    def write(self, folder: Path, **changes) -> Path:
        values = {key: getattr(self, key) for key in ("names", "camera_ids", "rotation", "translation")}
        values |= {key: changes.pop(key) for key in list(changes) if key in values}
        cameras = changes.pop("cameras", self.cameras)
        write_colmap_text(folder, cameras, **values, **(self.arrays | changes))
        return folder


def structure(n_images=6, n_points=40, seed=0, names=None) -> Structure:
    """Two lenses that look at a cloud from about 5 away; not all points are seen in all images."""
    rng = np.random.default_rng(seed)
    lens = ("OPENCV", 1280, 720, [900.0, 910.0, 640.0, 355.0, -0.1, 0.02, 1e-3, -5e-4])
    fish = ("OPENCV_FISHEYE", 1280, 720, [700.0, 705.0, 630.0, 365.0, 0.03, -0.01, 0.002, 0.0])
    rotation = Rotation.from_rotvec(rng.normal(0, 0.3, (n_images, 3))).as_matrix()
    translation = np.array([0, 0, 5.0]) + rng.normal(0, 0.4, (n_images, 3))
    xyz = rng.uniform(-1, 1, (n_points, 3))
    image, point = np.nonzero(rng.random((n_images, n_points)) < 0.8)
    names = names or [f"cam{i % 2}/{i // 2:06d}.png" for i in range(n_images)]
    return Structure(
        {3: lens, 8: fish},
        names,
        np.where(np.arange(n_images) % 2 == 0, 3, 8),
        rotation,
        translation,
        {
            "xyz": xyz,
            "rgb": rng.integers(0, 256, (n_points, 3)),
            "error": rng.uniform(0.1, 2, n_points),
            "observed_image": image,
            "observed_point": point,
            "observed_xy": rng.uniform(0, 700, (len(image), 2)),
        },
    )


def as_binary(folder: Path, out: Path, *, rigs: bool = True) -> Path:
    """The model as pycolmap writes it in binary, with or without the files of COLMAP 3.12."""
    out.mkdir()
    pycolmap.Reconstruction(str(folder)).write_binary(str(out))
    if not rigs:
        (out / "rigs.bin").unlink()
        (out / "frames.bin").unlink()
    return out


def same(first: ColmapModel, second: ColmapModel, tolerance: float = 1e-12) -> None:
    assert first.names == second.names
    for key in ARRAYS:
        a, b = getattr(first, key), getattr(second, key)
        assert a.shape == b.shape, key
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance, err_msg=key)
    np.testing.assert_allclose(first.cloud.xyz, second.cloud.xyz, rtol=0, atol=tolerance)
    np.testing.assert_array_equal(first.cloud.rgb, second.cloud.rgb)
    np.testing.assert_allclose(first.cloud.error, second.cloud.error, rtol=0, atol=tolerance)
    assert list(first.cameras) == list(second.cameras)
    for key, lens in first.cameras.items():
        assert (lens.model, lens.resolution) == (second.cameras[key].model, second.cameras[key].resolution)
        np.testing.assert_allclose(lens.parameters, second.cameras[key].parameters, rtol=0, atol=tolerance)


def pixels(model: ColmapModel) -> np.ndarray:
    """Predicted pixels of all observations, (K, 2)."""
    out = np.full(model.observed_xy.shape, np.nan)
    camera_ids = model.camera_ids[model.observed_image]
    for camera_id, lens in model.cameras.items():
        rows = np.flatnonzero(camera_ids == camera_id)
        moving = replace(lens, rotation=model.rotation, translation=model.translation)
        camera = at_rows(moving, model.observed_image[rows])
        out[rows] = camera.project(model.cloud.xyz[model.observed_point[rows]][:, None])[:, 0]
    return out


# ---------------------------------------------------------------------------------- what is written is read


def test_a_written_model_reads_back(tmp_path):
    s = structure()
    model = read_colmap(s.write(tmp_path / "m"))
    order = np.argsort(s.names)
    assert model.names == tuple(np.array(s.names)[order])
    np.testing.assert_array_equal(model.image_ids, order + 1)
    np.testing.assert_array_equal(model.camera_ids, s.camera_ids[order])
    np.testing.assert_allclose(model.rotation, s.rotation[order], rtol=0, atol=1e-12)
    np.testing.assert_allclose(model.translation, s.translation[order], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(model.cloud.xyz, s.arrays["xyz"])
    np.testing.assert_array_equal(model.cloud.rgb, s.arrays["rgb"])
    np.testing.assert_array_equal(model.cloud.error, s.arrays["error"])
    place = np.argsort(order)[s.arrays["observed_image"]]
    rows = np.argsort(place, kind="stable")
    np.testing.assert_array_equal(model.observed_image, place[rows])
    np.testing.assert_array_equal(model.observed_point, s.arrays["observed_point"][rows])
    np.testing.assert_allclose(model.observed_xy, s.arrays["observed_xy"][rows], rtol=0, atol=1e-9)
    assert model.cameras[3].model == "pinhole" and model.cameras[8].model == "fisheye"
    np.testing.assert_allclose(model.cameras[3].parameters[:8], s.cameras[3][3], rtol=0, atol=1e-9)
    np.testing.assert_allclose(model.cameras[8].parameters, s.cameras[8][3], rtol=0, atol=1e-9)
    assert model.declared_rigs == () and model.notes == ()


def test_the_same_arrays_make_the_same_bytes(tmp_path):
    for folder in ("a", "b"):
        structure().write(tmp_path / folder)
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_lenses_are_written_as_they_are(tmp_path):
    s = structure()
    first = read_colmap(s.write(tmp_path / "a"))
    again = read_colmap(s.write(tmp_path / "b", cameras=first.cameras))
    same(first, again, 1e-9)


@pytest.mark.parametrize("rigs", [True, False])
def test_text_and_binary_are_one_scene(tmp_path, rigs):
    text = structure().write(tmp_path / "text")
    binary = as_binary(text, tmp_path / "binary", rigs=rigs)
    same(read_colmap(text), read_colmap(binary))


def test_observations_are_where_pycolmap_projects_them(tmp_path):
    """Half a pixel, the order of images and points, and the lens: against pycolmap's own projection."""
    folder = structure().write(tmp_path / "m")
    model, reference = read_colmap(folder), pycolmap.Reconstruction(str(folder))
    ours = pixels(model)
    ids = sorted(reference.points3D)
    for k in range(0, len(ours), 7):
        image = reference.images[int(model.image_ids[model.observed_image[k]])]
        theirs = image.project_point(reference.points3D[ids[model.observed_point[k]]].xyz)
        np.testing.assert_allclose(ours[k], theirs - 0.5, rtol=0, atol=1e-7)


def test_a_model_without_points_or_observations(tmp_path):
    s = structure()
    s.arrays = {}
    model = read_colmap(s.write(tmp_path / "m"))
    assert len(model.cloud) == 0 and len(model.observed_xy) == 0 and model.cloud.xyz.shape == (0, 3)
    s.arrays = {"xyz": np.eye(3)}
    model = read_colmap(s.write(tmp_path / "n"))
    np.testing.assert_array_equal(model.cloud.xyz, np.eye(3))
    assert np.isnan(model.cloud.error).all()


def test_cameras_without_images_are_left_out(tmp_path):
    s = structure()
    folder = s.write(tmp_path / "m", camera_ids=np.full(len(s.names), 8))
    assert list(read_colmap(folder).cameras) == [8]


# ---------------------------------------------------------------------------------- pycolmap's own models


@pytest.fixture(scope="module")
def rigged(tmp_path_factory) -> Path:
    """Two rigs of two cameras each, three frames; text."""
    options = pycolmap.SyntheticDatasetOptions(num_rigs=2, num_cameras_per_rig=2, num_frames_per_rig=3)
    pycolmap.set_random_seed(1)
    folder = tmp_path_factory.mktemp("rigged")
    pycolmap.synthesize_dataset(options).write_text(str(folder))
    return folder


def test_rigs_and_frames(rigged, tmp_path):
    model, reference = read_colmap(rigged), pycolmap.Reconstruction(str(rigged))
    assert len(model.declared_rigs) == 2 and len(model.names) == 12
    by_id = {rig.rig_id: rig for rig in model.declared_rigs}
    for i, image_id in enumerate(model.image_ids.tolist()):
        image = reference.images[image_id]
        np.testing.assert_allclose(model.rotation[i], image.cam_from_world().rotation.matrix(), atol=1e-12)
        np.testing.assert_allclose(model.translation[i], image.cam_from_world().translation, atol=1e-12)
        assert model.frame_ids[i] == image.frame_id and model.rig_ids[i] == image.frame.rig_id
        rig = by_id[model.rig_ids[i]]
        sensor = rig.camera_ids.index(model.camera_ids[i])
        rig_from_world = image.frame.rig_from_world
        turned = rig.rotation[sensor] @ rig_from_world.rotation.matrix()
        moved = rig.rotation[sensor] @ rig_from_world.translation + rig.translation[sensor]
        np.testing.assert_allclose(turned, model.rotation[i], atol=1e-9)
        np.testing.assert_allclose(moved, model.translation[i], atol=1e-9)
    assert np.abs(by_id[1].translation[1]).max() > 1e-3
    same(model, read_colmap(as_binary(rigged, tmp_path / "b")))
    residual = np.linalg.norm(pixels(model) - model.observed_xy, axis=1)
    assert residual.max() < 1e-6


def test_images_without_a_pose_are_left_out(rigged, tmp_path):
    reconstruction = pycolmap.Reconstruction(str(rigged))
    reconstruction.deregister_frame(next(iter(reconstruction.frames)))
    reconstruction.write_binary(str(tmp_path))
    model = read_colmap(tmp_path)
    assert len(model.names) == 10


def test_quaternions_of_few_digits_are_normed(tmp_path):
    s = structure()
    folder = s.write(tmp_path / "m")
    lines = (folder / "images.txt").read_text().splitlines()
    words = lines[4].split()
    lines[4] = " ".join([words[0], *(f"{float(w):.4f}" for w in words[1:5]), *words[5:]])
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    model = read_colmap(folder)
    np.testing.assert_allclose(
        model.rotation @ model.rotation.swapaxes(1, 2), np.broadcast_to(np.eye(3), (6, 3, 3)), atol=1e-12
    )
    np.testing.assert_allclose(model.rotation[0], s.rotation[0], atol=1e-3)


# ---------------------------------------------------------------------------------- finding the model


@pytest.mark.parametrize("place", [".", "sparse", "sparse/0", "sfm", "dense/sparse", "0"])
def test_where_a_model_may_lie(tmp_path, place):
    folder = structure().write(tmp_path / place)
    model = read_colmap(tmp_path)
    assert model.path.resolve() == folder.resolve() and model.notes == ()


def test_of_several_models_the_one_with_most_images_is_read(tmp_path):
    structure(4).write(tmp_path / "sparse" / "0")
    large = structure(6).write(tmp_path / "large")
    (tmp_path / "sparse" / "10").mkdir()
    as_binary(large, tmp_path / "sparse" / "2")
    model = read_colmap(tmp_path)
    assert len(model.names) == 6 and model.path.name == "2"
    assert "0 (4)" in model.notes[0] and "(6)" in model.notes[0]


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_missing_file_is_named(tmp_path, name):
    folder = structure().write(tmp_path / "m")
    (folder / f"{name}.txt").unlink()
    assert f"{name}.txt" in message(read_colmap, folder).found


def test_no_model(tmp_path):
    assert "no COLMAP model" in message(read_colmap, tmp_path).problem
    assert message(read_colmap, tmp_path / "nothing").found == "nothing"
    (tmp_path / "file").write_text("")
    assert message(read_colmap, tmp_path / "file").found == "a file"


def test_without_pycolmap_the_remedy_is_named(tmp_path, monkeypatch):
    folder = structure().write(tmp_path / "m")
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert "acino-fte[colmap]" in message(read_colmap, folder).remedy


# ---------------------------------------------------------------------------------- broken models


@pytest.fixture(scope="module")
def binary(tmp_path_factory) -> Path:
    base = tmp_path_factory.mktemp("binary")
    return as_binary(structure().write(base / "t"), base / "b")


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Path:
    """As COLMAP wrote models before 3.12."""
    base = tmp_path_factory.mktemp("plain")
    return as_binary(structure().write(base / "t"), base / "b", rigs=False)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.5, 0.9, 0.999])
def test_a_binary_file_that_ends_too_early(binary, tmp_path, name, share):
    """pycolmap takes some of these for whole, and runs out of memory or time on others."""
    file = _broken(binary, tmp_path, name, lambda data: data[: min(int(share * len(data)), len(data) - 1)])
    error = message(read_colmap, tmp_path / "m")
    assert error.file in (str(file), str(file.parent))


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(
    "change",
    [
        lambda data: data + b"12345678",
        lambda data: bytes(255 - byte for byte in data),
        lambda data: b"\xff" * 8 + data[8:],
        lambda data: struct.pack("<Q", struct.unpack_from("<Q", data)[0] + 1) + data[8:],
        lambda data: np.random.default_rng(0).bytes(1000),
    ],
    ids=["longer", "inverted", "too many", "one more", "noise"],
)
def test_a_binary_file_of_nonsense(binary, tmp_path, name, change):
    _broken(binary, tmp_path, name, change)
    message(read_colmap, tmp_path / "m")


def _broken(source: Path, tmp_path: Path, name: str, change) -> Path:
    shutil.copytree(source, tmp_path / "m")
    file = tmp_path / "m" / f"{name}.bin"
    file.write_bytes(change(file.read_bytes()))
    return file


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize(
    "change",
    [
        lambda text: "these are no numbers\n" * 8,
        lambda text: text[: int(0.55 * len(text))].rpartition(" ")[0] + " 0.",
        lambda text: text.replace(" ", ","),
        lambda text: "1\n2\n3\n",
        lambda text: text.replace("0.", "nan "),
    ],
    ids=["words", "half", "commas", "few", "nan"],
)
def test_a_text_file_of_nonsense(tmp_path, name, change, capfd):
    folder = structure().write(tmp_path / "m")
    file = folder / f"{name}.txt"
    file.write_text(change(file.read_text()))
    message(read_colmap, folder)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 7.0, 0.0])
def test_impossible_poses(plain, tmp_path, value):
    """The quaternion of the first image: not finite, or no quaternion of a turn."""
    _broken(plain, tmp_path, "images", lambda data: data[:12] + struct.pack("<4d", *[value] * 4) + data[44:])
    error = message(read_colmap, tmp_path / "m")
    assert "images" in error.file or "not be read" in error.problem


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_shift_that_is_not_finite(plain, tmp_path, value):
    _broken(plain, tmp_path, "images", lambda data: data[:44] + struct.pack("<d", value) + data[52:])
    assert "images.bin" in message(read_colmap, tmp_path / "m").file


def test_a_point_that_is_not_finite(binary, tmp_path):
    _broken(binary, tmp_path, "points3D", lambda data: data[:16] + struct.pack("<d", np.nan) + data[24:])
    assert "points3D.bin" in message(read_colmap, tmp_path / "m").file


def test_a_camera_that_is_impossible(tmp_path):
    s = structure()
    for change in ((0, -900.0), (0, 0.0)):
        parameters = list(s.cameras[3][3])
        parameters[change[0]] = change[1]
        folder = s.write(tmp_path / "m", cameras=s.cameras | {3: (*s.cameras[3][:3], parameters)})
        error = message(read_colmap, folder)
        assert "cameras.txt" in error.file


def test_no_images(tmp_path):
    s = structure()
    empty = {"names": [], "camera_ids": np.zeros(0, dtype=int)}
    empty |= {"rotation": np.zeros((0, 3, 3)), "translation": np.zeros((0, 3))}
    s.arrays = {}
    folder = s.write(tmp_path / "m", **empty)
    error = message(read_colmap, folder)
    assert "No image" in error.problem and "images.txt" in error.file


def test_two_images_of_one_name(tmp_path):
    folder = structure().write(tmp_path / "m")
    file = folder / "images.txt"
    file.write_text(file.read_text().replace("cam0/000001.png", "cam0/000000.png"))
    assert "cam0/000000.png" in message(read_colmap, folder).found


def test_a_name_that_is_no_text(plain, tmp_path):
    _broken(plain, tmp_path, "images", lambda data: data.replace(b"cam1/000001", b"cam1/\xe4\xf60001"))
    assert "images.bin" in message(read_colmap, tmp_path / "m").file


def test_points_in_any_order(plain, tmp_path):
    def backwards(data: bytes) -> bytes:
        records, at = [], 8
        while at < len(data):
            (length,) = struct.unpack_from("<Q", data, at + 43)
            records.append(data[at : at + 51 + 8 * length])
            at += len(records[-1])
        return data[:8] + b"".join(records[::-1])

    _broken(plain, tmp_path, "points3D", backwards)
    same(read_colmap(tmp_path / "m"), read_colmap(plain))


def test_pixels_that_are_not_finite_are_noted(plain, tmp_path):
    first = 8 + 64 + len("cam0/000000.png") + 1 + 8
    _broken(
        plain, tmp_path, "images", lambda data: data[:first] + struct.pack("<d", np.nan) + data[first + 8 :]
    )
    model, whole = read_colmap(tmp_path / "m"), read_colmap(plain)
    assert "no finite pixel" in model.notes[0]
    np.testing.assert_array_equal(model.observed_xy, whole.observed_xy[1:])


def test_points_that_are_missing_are_noted(tmp_path):
    """A text file that ends at the end of a line: pycolmap takes it for whole."""
    folder = structure().write(tmp_path / "m")
    file = folder / "points3D.txt"
    lines = file.read_text().splitlines(keepends=True)
    whole = read_colmap(folder)
    file.write_text("".join(lines[:-10]))
    model = read_colmap(folder)
    assert len(model.cloud) == len(whole.cloud) - 10
    assert "points3D lacks" in model.notes[0]
    kept = whole.observed_point < len(model.cloud)
    np.testing.assert_array_equal(model.observed_xy, whole.observed_xy[kept])
    np.testing.assert_array_equal(model.observed_point, whole.observed_point[kept])


# ---------------------------------------------------------------------------------- what cannot be written


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"camera_ids": np.zeros(6, dtype=int)}, "camera"),
        ({"names": ["a b"] + [f"{i}" for i in range(5)]}, "spaces"),
        ({"names": ["a"] * 6}, "one name"),
        ({"rotation": np.zeros((5, 3, 3))}, "rotation"),
        ({"rotation": np.tile(-np.eye(3), (6, 1, 1))}, "rotation"),
        ({"translation": np.full((6, 3), np.nan)}, "translation"),
        ({"xyz": np.zeros((2, 3)), "rgb": None, "error": None}, "nothing"),
        ({"rgb": np.zeros((2, 3))}, "rgb"),
        ({"observed_xy": None}, "Observations"),
    ],
)
def test_what_cannot_be_written(tmp_path, changes, said):
    with pytest.raises(InputError, match=said):
        structure().write(tmp_path / "m", **changes)


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "m").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        structure().write(tmp_path / "m")


@pytest.mark.parametrize("kind", [k for k in pycolmap.CameraModelId.__members__ if k != "INVALID"])
def test_every_camera_model_comes_back(tmp_path, kind):
    """Half a pixel is taken off the right two parameters and put back on them."""
    theirs = pycolmap.Camera.create_from_model_name(3, kind, 900.0, 1280, 640)
    lens = camera_from_colmap(theirs, "c")
    ours = np.array(theirs.params)
    ours[theirs.principal_point_idxs()] -= 0.5
    s = structure()
    by_numbers = read_colmap(s.write(tmp_path / "a", cameras={3: (kind, 1280, 640, ours), 8: s.cameras[8]}))
    np.testing.assert_allclose(by_numbers.cameras[3].parameters, lens.parameters, rtol=0, atol=1e-9)
    by_lens = read_colmap(s.write(tmp_path / "b", cameras={3: lens, 8: s.cameras[8]}))
    assert isinstance(by_lens.cameras[3], Camera)
    rays = np.random.default_rng(0).uniform([-0.2, -0.2, 1], [0.2, 0.2, 1], (9, 3))
    np.testing.assert_allclose(by_lens.cameras[3].project(rays), lens.project(rays), rtol=0, atol=1e-8)


# ---------------------------------------------------------------------------------- real models


@needs(KITTI)
def test_kitti_as_text_and_as_binary():
    text, binary = read_colmap(KITTI / "colmap_txt"), read_colmap(KITTI / "colmap_bin")
    same(text, binary, 1e-11)
    assert len(text.names) == 40 and len(text.cloud) == 2846 and len(text.observed_xy) == 20204
    residual = np.linalg.norm(pixels(text) - text.observed_xy, axis=1)
    assert 0.3 < np.median(residual) < 0.6


@needs(LUND)
def test_lund_doors_points_lie_where_its_observations_meet():
    model = read_colmap(LUND)
    assert (len(model.names), len(model.cloud), len(model.observed_xy)) == (12, 11384, 73327)
    lens = model.cameras[1]
    i, k = model.observed_image, model.observed_point
    local = np.concatenate([lens.undistort(model.observed_xy), np.ones((len(k), 1))], axis=1)
    turned = np.einsum("nji,nj->ni", model.rotation[i], local)
    ray = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    centre = -np.einsum("nji,nj->ni", model.rotation, model.translation)[i]
    # least squares of the distances from the rays, each over its depth, as pixels count them
    depth = np.linalg.norm(model.cloud.xyz[k] - centre, axis=1)
    across = (np.eye(3) - ray[:, :, None] * ray[:, None]) / depth[:, None, None] ** 2
    normal, right = np.zeros((2, len(model.cloud), 3, 3))
    np.add.at(normal, k, across)
    np.add.at(right[:, 0], k, np.einsum("nij,nj->ni", across, centre))
    points = np.linalg.solve(normal, right[:, 0, :, None])[..., 0]
    extent = np.linalg.norm(np.percentile(model.cloud.xyz, 99, 0) - np.percentile(model.cloud.xyz, 1, 0))
    distance = np.linalg.norm(points - model.cloud.xyz, axis=1) / extent
    assert np.median(distance) < 1e-4
    assert np.sqrt(np.mean(distance**2)) < 1e-3
    assert np.mean(distance < 1e-3) > 0.99


@pytest.mark.parametrize("folder", RIGS, ids=lambda p: p.name)
def test_rigs_of_mvt(folder):
    if not folder.is_dir():
        pytest.skip(f"shared/data/{folder.name} is absent")
    model = read_colmap(folder)
    assert len(model.cameras) == 4 and len(model.names) > 2800
    assert {lens.model for lens in model.cameras.values()} == {
        "fisheye" if "fisheye" in folder.name else "pinhole"
    }
    residual = np.linalg.norm(pixels(model) - model.observed_xy, axis=1)
    assert 1.0 < np.median(residual) < 1.6
