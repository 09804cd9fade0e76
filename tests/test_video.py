"""Videos: every frame is found by its number, cut files give what decodes, and folders serve as videos."""

import subprocess
import sys

import numpy as np
import pytest

from acino_fte.data_tools.pictures import PictureFolder, natural_order, open_pictures
from acino_fte.data_tools.video import VideoReader
from acino_fte.data_tools.video_write import write_video
from acino_fte.errors import InputError

pytest.importorskip("av")
cv2 = pytest.importorskip("cv2")

N = 75
RATE = 60.0


def picture(number: int) -> np.ndarray:
    """A frame (48, 64, 3) that says its number in eight black or white squares, over a moving gradient."""
    x = np.arange(64)[None] + 2 * number
    pixels = np.broadcast_to((60 + 40 * np.sin(x / 9))[..., None], (48, 64, 3)).astype(np.uint8).copy()
    for bit in range(8):
        pixels[8:24, 8 * bit : 8 * bit + 8] = 255 if number >> bit & 1 else 0
    return pixels


def number_of(pixels: np.ndarray) -> int:
    return sum(int(pixels[16, 8 * bit + 4].mean() > 127) << bit for bit in range(8))


FRAMES = [picture(n) for n in range(N)]
STAMPS = np.cumsum(np.random.default_rng(3).integers(4, 40, N)) * 1_000_000  # ms: what Matroska can say


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    """Matroska of varying rate with B-frames, fragmented MP4 of constant rate, lossless AVI."""
    folder = tmp_path_factory.mktemp("videos")
    assert write_video(folder / "a.mkv", FRAMES, RATE, STAMPS, keyframe_every=20) == N
    write_video(folder / "b.mp4", iter(FRAMES), RATE, keyframe_every=20)
    write_video(folder / "c.avi", FRAMES, RATE, codec="ffv1", keyframe_every=20)
    return folder


@pytest.mark.parametrize("name", ["a.mkv", "b.mp4", "c.avi"])
def test_frames_by_number_are_those_of_the_stream(videos, name):
    with VideoReader(videos / name) as reader:
        streamed = [record.value for record in reader.records()]
        assert reader.damage.whole and reader.damage.n_read == N == len(reader) == len(streamed)
        assert [number_of(p.pixels) for p in streamed] == list(range(N)) == [p.number for p in streamed]
        order = np.random.default_rng(0).permutation(N)[:25]
        for n in [0, N - 1, *order, 41, 40, 39, 38, 38, 20, 19, 21]:
            at = reader.at(int(n))
            assert number_of(at.pixels) == n == at.number
            assert at.time_ns == streamed[n].time_ns
            np.testing.assert_array_equal(at.pixels, streamed[n].pixels)


def test_times_are_those_that_were_written(videos):
    with VideoReader(videos / "a.mkv") as reader:
        np.testing.assert_array_equal(reader.stamps_ns, STAMPS - STAMPS[0])
    with VideoReader(videos / "b.mp4") as reader:
        np.testing.assert_allclose(reader.stamps_ns, np.arange(N) / RATE * 1e9, atol=1000)
        assert reader.fps == pytest.approx(RATE, rel=1e-3) and reader.size == (64, 48)


def test_lossless_video_keeps_every_pixel(videos):
    with VideoReader(videos / "c.avi") as reader:
        np.testing.assert_array_equal(reader.at(7).pixels, FRAMES[7])


@pytest.mark.parametrize("name", ["a.mkv", "b.mp4", "c.avi"])
@pytest.mark.parametrize("fraction", [0.3, 0.55, 0.8, 0.999])
def test_cut_video_gives_its_frames_before_the_cut(videos, tmp_path, name, fraction):
    data = (videos / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(fraction * len(data))])
    with VideoReader(tmp_path / name) as reader:
        numbers = [number_of(record.value.pixels) for record in reader.records()]
        assert numbers[:-1] == list(range(len(numbers) - 1))  # B-frames come after the frame that they end at
        assert len(numbers) >= fraction * N - 26  # a group of pictures; heads take a share of the bytes
        assert not reader.damage.whole
        if numbers:
            assert number_of(reader.at(len(numbers) - 1).pixels) == numbers[-1]


def test_damaged_bytes_cost_no_more_than_their_group(videos, tmp_path):
    data = bytearray((videos / "a.mkv").read_bytes())
    middle = len(data) // 2
    data[middle : middle + 60] = bytes(60)
    (tmp_path / "a.mkv").write_bytes(data)
    with VideoReader(tmp_path / "a.mkv") as reader:
        numbers = [number_of(record.value.pixels) for record in reader.records()]
        assert numbers[:10] == list(range(10)) and numbers[-10:] == list(range(N - 10, N))


def test_folder_of_images_is_in_natural_order(tmp_path):
    for n in (1, 2, 10, 9):
        cv2.imwrite(str(tmp_path / f"frame{n}.png"), FRAMES[n][..., ::-1])
    (tmp_path / "notes.txt").write_text("x")
    with open_pictures(tmp_path, fps=10) as folder:
        assert len(folder) == 4 and folder.fps == 10 and isinstance(folder, PictureFolder)
        for i, n in enumerate((1, 2, 9, 10)):
            np.testing.assert_array_equal(folder.at(i).pixels, FRAMES[n])
        assert folder.at(3).time_ns == 300_000_000
        with pytest.raises(InputError, match="0 to 3"):
            folder.at(4)
    assert sorted(["b2", "b10", "2", "a"], key=natural_order) == ["2", "a", "b2", "b10"]
    assert len(open_pictures(tmp_path / "frame1.png")) == 1


def test_grey_and_deep_images(tmp_path):
    deep = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64) * 20
    cv2.imwrite(str(tmp_path / "0.png"), deep)
    np.testing.assert_array_equal(open_pictures(tmp_path).at(0).pixels, deep)
    write_video(tmp_path / "g.mkv", [FRAMES[3][..., 0]], 30, codec="ffv1")
    np.testing.assert_array_equal(open_pictures(tmp_path / "g.mkv").at(0).pixels, FRAMES[3][..., 0])


def test_turned_video_is_shown_upright(videos, tmp_path):
    """The matrix in the head of an MP4 turns the picture by a quarter clockwise, for OpenCV too."""
    data = bytearray((videos / "b.mp4").read_bytes())
    one, at = 1 << 16, data.index(b"tkhd") + 4 + 40
    data[at : at + 36] = np.array([0, one, 0, -one & 0xFFFFFFFF, 0, 0, 48 * one, 0, 1 << 30], ">u4").tobytes()
    (tmp_path / "b.mp4").write_bytes(data)
    with VideoReader(tmp_path / "b.mp4") as reader, VideoReader(videos / "b.mp4") as upright:
        turned = reader.at(5).pixels
        np.testing.assert_array_equal(turned, np.rot90(upright.at(5).pixels, -1))
    _, other = cv2.VideoCapture(str(tmp_path / "b.mp4")).read()
    assert other.shape == turned.shape


def test_what_is_no_video_is_said(tmp_path):
    for name, data in (("empty.mp4", b""), ("text.mkv", b"hello world\n" * 100)):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match="cannot be read"):
            VideoReader(tmp_path / name)
    for path in (tmp_path / "none.mp4", tmp_path):
        with pytest.raises(InputError, match="no such"):
            VideoReader(path)
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(InputError, match="cannot be read"):
        open_pictures(tmp_path / "text.png").at(0)
    (tmp_path / "only").mkdir()
    with pytest.raises(InputError, match="no pictures"):
        open_pictures(tmp_path / "only")


def test_a_failed_video_leaves_nothing(tmp_path):
    def frames():
        yield FRAMES[0]
        yield FRAMES[1][:20]

    for bad, stamps in ((frames(), None), ([], None), (FRAMES[:3], [0, 10**9, 10**8])):
        with pytest.raises(InputError):
            write_video(tmp_path / "x.mkv", bad, 30, stamps)
    with pytest.raises(InputError, match=r"\.mkv"):
        write_video(tmp_path / "x.gif", FRAMES[:2], 30)
    with pytest.raises(InputError, match="codec"):
        write_video(tmp_path / "x.mkv", FRAMES[:2], 30, codec="nothing")
    assert not list(tmp_path.iterdir())


def test_import_needs_neither_av_nor_opencv():
    code = "import sys, acino_fte.data_tools.pictures; print({'av', 'cv2'} & set(sys.modules))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "set()"
