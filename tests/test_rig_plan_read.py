"""rig.yaml: what is written is read back, and what is wrong in it is named."""

from pathlib import Path

import pytest

from acino_fte.errors import InputError
from acino_fte.rig.rig_file import CameraPart, EncoderPart, Lens, LidarPart, RigFile
from acino_fte.rig.rig_read import checked_rig, find_rig_file, read_rig, rig_text, write_rig

EXAMPLE = Path(__file__).resolve().parent.parent / "examples" / "rig.yaml"
HEAD = "format: acino-fte/rig/1\n"


def read(tmp_path, text):
    path = tmp_path / "rig.yaml"
    path.write_text(text, encoding="utf-8")
    return read_rig(path)


def test_the_example_is_the_default_rig_as_a_new_file_has_it():
    assert EXAMPLE.read_text(encoding="utf-8") == rig_text(RigFile())
    assert read_rig(EXAMPLE) == RigFile()


def test_every_number_survives_the_file_and_every_key_is_explained(tmp_path):
    rig = RigFile(
        name="on: the road #2",
        cameras={
            "wide": CameraPart(codec="raw", fps=1 / 3, lens=Lens(focal_mm=(8, 8), used_mm=8)),
            "no": CameraPart(exposure_us=1e-7, bits=12),
        },
        lidars={"front": LidarPart(returns="dual", points=96_000)},
        encoders={"pan": EncoderPart(counts_per_turn=4741.44)},
    )
    write_rig(tmp_path / "rig.yaml", rig)
    assert read_rig(tmp_path) == rig
    bare = RigFile(cameras={}, lidars={}, encoders={})
    write_rig(tmp_path / "rig.yaml", bare)
    assert read_rig(tmp_path / "rig.yaml") == bare
    lines = rig_text(RigFile()).splitlines()
    unexplained = [line for line in lines if "#" not in line and not line.endswith(":")]
    assert unexplained == ["format: acino-fte/rig/1", "name: rig"]


def test_what_is_left_out_has_its_default(tmp_path):
    rig = read(tmp_path, HEAD + "cameras:\n  cam1:\n    lens: {used_mm: 80}\n")
    assert rig.cameras["cam1"].lens == Lens(used_mm=80)
    assert rig.model_copy(update={"cameras": RigFile().cameras}) == RigFile()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name: rig\n", ["format: acino-fte/rig/1"]),
        ("- a\n- b\n", ["found:    list", "--init"]),
        ("", ["found:    nothing"]),
        (HEAD + "storge: {ram_gb: 16}\n", ["did you mean 'storage'?"]),
        (HEAD + "cameras: {cam1: {lens: {f_numbr: 4}}}\n", ["cameras.cam1.lens", "did you mean 'f_number'?"]),
        (HEAD + "cameras: {cam1: {fps: fast}}\n", ["cameras.cam1.fps", "fast"]),
        (HEAD + "cameras: {cam1: {fps: .inf}}\n", ["cameras.cam1.fps", "finite"]),
        (HEAD + "cameras: {cam1: {codec: h265}}\n", ["cameras.cam1.codec", "h264", "h265"]),
        (HEAD + "cameras: {cam1: {fps: 60, fps: 30}}\n", ["'fps' is given twice"]),
        (HEAD + "cameras: {1: {}}\n", ["cameras", "quotes"]),
        (HEAD + "cameras: {a/b: {}}\n", ["no name for files", "'a/b'"]),
        (HEAD + "cameras: {eye: {}}\nlidars: {eye: {}}\n", ["same name", "'eye'"]),
        (HEAD + "cameras: {cam1: {lens: {used_mm: 200}}}\n", ["from 5 to 150 mm", "200 mm"]),
        (HEAD + "cameras: {cam1: {lens: {focal_mm: [150, 5]}}}\n", ["range of focal lengths", "[150, 5]"]),
        (HEAD + "cameras: {cam1: {lens: {focus_m: 0.2}}}\n", ["focus that near", "0.2 m"]),
        (HEAD + "lidars: {lidar1: {fov_deg: [0, 16]}}\n", ["no such field", "[0.0, 16.0]"]),
        (HEAD + "wishes: {distance_m: 1.0e+308}\n", ["wishes.distance_m", "No rig has", "1e+308"]),
        (HEAD + "cameras: {cam1: {pixel_um: 1.0e-300}}\n", ["cameras.cam1.pixel_um", "No rig has"]),
        (HEAD + "cameras: {cam1: {lens: {focal_mm: [1.0e-12, 5]}}}\n", ["cam1.lens.focal_mm", "No rig has"]),
        (HEAD + "cameras: {cam1: {width: 10000000000000}}\n", ["cameras.cam1.width", "No rig has"]),
        (HEAD + "cameras: {cam1: {line_us: 0, frame_overhead_us: 0}}\n", ["takes no time"]),
        (HEAD + "storage: {ram_gb: -1}\nwishes: {hours: 0}\n", ["storage.ram_gb", "1 more fault"]),
        ("cameras: [\n", ["not valid YAML", "line 2"]),
        ("!!python/object/apply:os.system [id]\n", ["not valid YAML"]),
    ],
)
def test_a_fault_is_named_with_its_place(tmp_path, text, said):
    with pytest.raises(InputError) as error:
        read(tmp_path, text)
    assert str(tmp_path / "rig.yaml") in str(error.value)
    assert [part for part in said if part not in str(error.value)] == []


def test_a_missing_file_an_empty_folder_and_another_kind(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="does not exist"):
        read_rig(tmp_path / "none.yaml")
    with pytest.raises(InputError, match=r"holds no rig\.yaml"):
        read_rig(tmp_path)
    (tmp_path / "a.mp4").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="not text"):
        read_rig(tmp_path / "a.mp4")
    monkeypatch.chdir(tmp_path)
    assert find_rig_file() is None
    write_rig("rig.yaml")
    assert find_rig_file() == Path("rig.yaml")


def test_plain_data_are_checked_like_a_file():
    with pytest.raises(InputError, match="fault at 'nam'"):
        checked_rig({"nam": 1})
