"""Rescue of videos: cut Matroska and fragmented MP4 are copied; an MP4 without its index is rebuilt."""

import numpy as np
import pytest

from acino_fte.data_tools.video_write import write_video
from acino_fte.errors import InputError
from acino_fte.rig.recover import recover

av = pytest.importorskip("av")
N, FPS = 60, 30


def frames():
    for i in range(N):
        picture = np.full((48, 64, 3), i * 3, np.uint8)
        picture[i % 40 : i % 40 + 8, 5:20] = 255 - i
        yield picture


def decoded(path):
    """Times (s) and bytes of all frames, as FFmpeg shows them."""
    with av.open(str(path)) as container:
        return [(float(f.time), f.to_ndarray(format="gray").tobytes()) for f in container.decode(video=0)]


def packets(path):
    """(time, bytes) of the packets that are whole."""
    with av.open(str(path)) as container:
        base = container.streams.video[0].time_base
        return [
            (round(float(p.pts * base) * 1e6), bytes(p))
            for p in container.demux(video=0)
            if p.size and not p.is_corrupt
        ]


def plain_mp4(path, b_frames=0):
    """As cameras write it: the pictures, then the index."""
    with av.open(str(path), "w", format="mp4") as out:
        stream = out.add_stream("libx264", rate=FPS, options={"bf": str(b_frames)})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.gop_size = 12
        for picture in frames():
            out.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        out.mux(stream.encode())
    return path


@pytest.mark.parametrize("suffix", [".mkv", ".mp4"])
def test_a_cut_video_is_copied(suffix, tmp_path):
    """Times that are no multiple of anything; every whole frame before the cut is in the copy, unchanged."""
    stamps = np.cumsum(np.random.default_rng(1).integers(20, 50, N)) * 1_000_000
    whole, cut = tmp_path / f"whole{suffix}", tmp_path / f"cut{suffix}"
    write_video(whole, frames(), FPS, stamps, keyframe_every=10)
    data, everything = whole.read_bytes(), packets(whole)
    ends = [data.index(raw) + len(raw) for _, raw in everything]
    for part in (0.45, 0.71, 0.97):
        cut.write_bytes(data[: int(part * len(data))])
        found = recover(cut, tmp_path / f"copy{part}{suffix}")
        copied = packets(found.copy)
        assert copied == everything[: len(copied)] and found.saved == len(copied)
        before = sum(end <= part * len(data) for end in ends)
        assert len(copied) == before
        assert not found.whole and len(decoded(found.copy)) == len(copied)
        assert recover(found.copy).whole
    assert recover(whole).whole and recover(whole).saved == N


@pytest.mark.parametrize("b_frames", [0, 2])
def test_an_mp4_without_its_index(b_frames, tmp_path):
    """Rebuilt with a sound one of the same camera: the same pictures in the same order at the same times."""
    good = plain_mp4(tmp_path / "good.mp4", b_frames)
    data, everything = good.read_bytes(), decoded(good)
    (tmp_path / "lost").mkdir()
    lost = tmp_path / "lost" / "clip.mp4"
    lost.write_bytes(data[: data.index(b"moov") - 4])
    with pytest.raises(InputError, match="--like GOOD.mp4"):
        recover(lost)
    assert list(lost.parent.iterdir()) == [lost]
    found = recover(lost, like=good)
    assert found.copy.name == "clip-recovered.mp4" and found.saved == N
    again = decoded(found.copy)
    assert [p for _, p in again] == [p for _, p in everything]
    np.testing.assert_allclose([t for t, _ in again], [t for t, _ in everything], atol=1e-3)
    begin = data.index(b"mdat") + 4
    lost.write_bytes(data[: begin + (data.index(b"moov") - begin) * 2 // 3])
    half = decoded(recover(lost, tmp_path / "half.mp4", like=good).copy)
    assert N // 3 < len(half) < N
    same = sum(p == q for (_, p), (_, q) in zip(half, everything, strict=False))
    assert same >= len(half) - b_frames - 1


def test_a_sound_video_beside_it_or_the_stream_itself_tells_how_it_is_encoded(tmp_path):
    good = plain_mp4(tmp_path / "a.mp4")
    data = good.read_bytes()
    lost = tmp_path / "b.mp4"
    lost.write_bytes(data[: data.index(b"moov") - 4])
    found = recover(lost)
    assert found.saved == N and any("a.mp4" in note for note in found.notes)
    good.unlink()
    (tmp_path / "b-recovered.mp4").unlink()
    with av.open(str(tmp_path / "annex"), "w", format="h264") as out:  # parameter sets in the stream
        stream = out.add_stream("libx264", rate=FPS, options={"bf": "0"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for picture in frames():
            out.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        out.mux(stream.encode())
    units = [
        u for u in (tmp_path / "annex").read_bytes().replace(b"\0\0\0\1", b"\0\0\1").split(b"\0\0\1") if u
    ]
    body = b"".join(len(u).to_bytes(4, "big") + u for u in units)
    lost.write_bytes(b"\0\0\0\x10ftypisom\0\0\0\0" + b"\0\0\0\0mdat" + body)
    own = recover(lost, tmp_path / "own.mp4", fps=50)
    assert own.saved == N and any("stream itself" in note for note in own.notes)
    assert decoded(own.copy)[-1][0] == pytest.approx((N - 1) / 50, abs=1e-3)


def test_an_mp4_that_cannot_be_rebuilt_is_said(tmp_path):
    lost = tmp_path / "lost.mp4"
    noise = np.random.default_rng(3).integers(0, 256, 20_000).astype("u1").tobytes()
    lost.write_bytes(b"\0\0\0\x10ftypisom\0\0\0\0" + b"\0\0\0\0mdat" + noise)
    with pytest.raises(InputError, match="H.264"):
        recover(lost)
    (tmp_path / "lost.mkv").write_bytes(b"\x1a\x45\xdf\xa3" + noise)
    with pytest.raises(InputError, match="head is lost"):
        recover(tmp_path / "lost.mkv")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["lost.mkv", "lost.mp4"]


@pytest.mark.parametrize("bits, width", [(8, 63), (12, 64)])
def test_a_cut_video_of_every_pixel_is_copied(bits, width, tmp_path):
    """As the recorder writes it with ``codec: raw``: raw pixels, lossless where these are deeper."""
    from acino_fte.rig.rig_file import CameraPart
    from acino_fte.rig.writers_video import VideoFile, choose_codec

    part = CameraPart(width=width, height=47, bits=bits, codec="raw", fps=FPS)
    pixels = (
        np.random.default_rng(0).integers(0, 1 << bits, (20, 47, width)).astype(f"uint{8 * (1 + (bits > 8))}")
    )
    path = tmp_path / "cam1-0000.mkv"
    video = VideoFile(path, "cam1", part, choose_codec(part), 0, pixels[0])
    for i, picture in enumerate(pixels):
        video.write(picture, round(i * 1e9 / FPS))
    video.close()
    whole = decoded(path)
    path.write_bytes(path.read_bytes()[: int(0.6 * path.stat().st_size)])
    found = recover(path, tmp_path / "copy.mkv")
    n = len(packets(path))
    assert found.saved == n > 5
    assert decoded(tmp_path / "copy.mkv") == whole[:n]
