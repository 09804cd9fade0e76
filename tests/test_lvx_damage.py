"""Cut and damaged LVX files: all whole packages before and after the damage are read, the others counted."""

import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lvx_synthetic import collected, packages, recording

from acino_fte.data_tools.lvx import LvxReader
from acino_fte.data_tools.lvx_packets import LAYOUTS
from acino_fte.data_tools.lvx_recognise import PackageTest
from acino_fte.data_tools.lvx_walk import Walk
from acino_fte.errors import InputError

VERSIONS = ["1.0", "1.1", "2"]


@pytest.fixture(scope="module", params=VERSIONS)
def whole(request, tmp_path_factory):
    """A file of some 24 packages, its packages, and its values."""
    path = tmp_path_factory.mktemp("lvx") / "whole.lvx"
    data = recording(path, request.param, n_frames=8, per=2, share=0.9)
    return request.param, data, packages(data, request.param), collected(LvxReader(path))


def expected(whole, kept: list[bool]) -> dict[str, np.ndarray]:
    """Times of the returns and samples of some of the packages, by stream."""
    _, _, all_packages, values = whole
    out = {}
    for stream, columns in values.items():
        chosen = [(p[2], k) for p, k in zip(all_packages, kept, strict=True) if p[3] == (stream == "imu0")]
        stamps, keep = (np.array(column) for column in zip(*chosen, strict=True))
        out[stream] = keep[np.searchsorted(stamps, columns["time_ns"], "right") - 1]
    return out


def assert_read(reader, whole, kept, exactly: bool) -> None:
    """Everything of the kept packages is there as it was; nothing else either, if `exactly`."""
    values, got = whole[3], collected(reader)
    for stream, keep in expected(whole, kept).items():
        if not keep.any() and stream not in got:
            continue
        here = np.isin(got[stream]["time_ns"], values[stream]["time_ns"][keep])
        if exactly:
            assert here.all()
        for name, column in values[stream].items():
            np.testing.assert_array_equal(got[stream][name][here], column[keep], err_msg=f"{stream} {name}")


def test_cut_at_every_200th_of_its_length(whole, tmp_path):
    """All whole packages before the cut, no exception, and the cut is told."""
    version, data, all_packages, _ = whole
    path = tmp_path / "cut.lvx"
    for k in range(1, 200):
        length = len(data) * k // 200
        path.write_bytes(data[:length])
        reader = LvxReader(path)
        kept = [stop <= length for _, stop, *_ in all_packages]
        assert_read(reader, whole, kept, exactly=True)
        damage = reader.damage
        assert damage.n_read == sum(kept), k
        at_edge = length in {stop for _, stop, *_ in all_packages}
        assert not damage.whole or at_edge, k
        if any(start < length < stop for start, stop, *_ in all_packages):
            assert damage.n_lost >= 1 and "ends within" in damage.places[-1], k


@pytest.mark.parametrize("how", ["zeros", "noise", "insert", "remove"])
def test_damage_in_the_middle(whole, tmp_path, how):
    """Everything whole before and after; of a damage within the file, the count of packages is exact."""
    version, data, all_packages, _ = whole
    choose = random.Random(f"{version} {how}")
    path = tmp_path / "damaged.lvx"
    first, last = len(data) // 4, 3 * len(data) // 4
    for _ in range(15):
        start = choose.randrange(first, last)
        length = choose.choice([1, 7, 24, 60, 400, 1363, 3000, len(data) // 8])
        stop = start if how == "insert" else start + length
        between = {"zeros": bytes(length), "remove": b""}.get(how, choose.randbytes(length))
        path.write_bytes(data[:start] + between + data[stop:])
        reader = LvxReader(path)
        kept = [b <= start or a >= stop for a, b, *_ in all_packages]
        assert_read(reader, whole, kept, exactly=False)
        damage = reader.damage
        assert sum(kept) <= damage.n_read <= len(all_packages)
        assert damage.n_read + damage.n_lost == len(all_packages), (start, length, damage)


def test_bytes_lost_from_a_header(whole, tmp_path):
    """One or two bytes of a frame's header are gone: its packages and those before it are not."""
    version, data, all_packages, _ = whole
    path = tmp_path / "damaged.lvx"
    stops = {stop for _, stop, *_ in all_packages}
    first = [start for start, *_ in all_packages if start not in stops][3]
    size = LAYOUTS[version].frame_bytes
    for at in range(first - size, first - 1, 3):
        for length in (1, 2):
            path.write_bytes(data[:at] + data[at + length :])
            reader = LvxReader(path)
            assert_read(reader, whole, [True] * len(all_packages), exactly=True)
            assert reader.damage.n_read == len(all_packages) and reader.damage.n_lost == 0


def test_two_damages_and_a_package_alone_between(whole, tmp_path):
    """It is known by the lidar's earlier ones."""
    version, data, all_packages, _ = whole
    lidar = [i for i, p in enumerate(all_packages) if not p[3]]
    alone = lidar[len(lidar) // 2]
    (before, *_), (_, after, *_) = all_packages[alone - 2], all_packages[alone + 2]
    start, stop, *_ = all_packages[alone]
    noise = random.Random(5).randbytes(len(data))
    path = tmp_path / "damaged.lvx"
    path.write_bytes(
        data[:before] + noise[before:start] + data[start:stop] + noise[stop:after] + data[after:]
    )
    reader = LvxReader(path)
    kept = [b <= before or a >= after or i == alone for i, (a, b, *_) in enumerate(all_packages)]
    assert_read(reader, whole, kept, exactly=False)
    assert reader.damage.n_read == sum(kept)
    assert len(reader.damage.places) >= 2


def test_a_file_without_any_frame_header(whole, tmp_path):
    """Packages alone, one after the other, behind a good head: all are read, a part at a time."""
    version, data, all_packages, _ = whole
    head = data[: LAYOUTS[version].data_start(1)]
    path = tmp_path / "bare.lvx"
    path.write_bytes(head + b"".join(data[a:b] for a, b, *_ in all_packages))
    reader = LvxReader(path)
    assert_read(reader, whole, [True] * len(all_packages), exactly=True)
    assert reader.damage.whole


def test_recordings_one_after_the_other(whole, tmp_path):
    """As a copy that went wrong: the second head is a hole, its frames are read."""
    version, data, all_packages, _ = whole
    path = tmp_path / "twice.lvx"
    path.write_bytes(data + data)
    reader = LvxReader(path)
    collected(reader)
    assert reader.damage.n_read == 2 * len(all_packages)
    assert reader.damage.bytes_lost == LAYOUTS[version].data_start(1)
    assert any("jumped" in place for place in reader.damage.places)


@settings(max_examples=40)
@given(st.binary(max_size=3_000), st.sampled_from([b"", b"livox_tech".ljust(16, b"\0")]), st.integers(0, 255))
def test_random_bytes(tmp_path_factory, content, start, version):
    """No recording: one message. With the name of one: no exception."""
    path = tmp_path_factory.getbasetemp() / "random.lvx"
    path.write_bytes(start + (bytes((version % 4, version // 128, 0, 0)) if start else b"") + content)
    try:
        reader = LvxReader(path)
    except InputError as error:
        assert not start and error.file == str(path)
        return
    records = list(reader.records())
    assert reader.damage.n_read >= len(records)
    assert isinstance(reader.notes, tuple) and isinstance(reader.streams, tuple)


@settings(max_examples=40)
@given(st.data())
def test_any_damages(tmp_path_factory, data):
    """Bytes written over a file at several places, its head too: no exception, no package invented."""
    version = data.draw(st.sampled_from(VERSIONS))
    path = tmp_path_factory.getbasetemp() / "any.lvx"
    content = bytearray(recording(path, version, n_frames=3, per=2))
    n = len(packages(bytes(content), version))
    for _ in range(data.draw(st.integers(1, 6))):
        patch = data.draw(st.binary(min_size=1, max_size=40))
        at = data.draw(st.integers(0, len(content) - len(patch)))
        content[at : at + len(patch)] = patch
    path.write_bytes(content)
    try:
        reader = LvxReader(path)
    except InputError:
        return
    for record in reader.records():
        columns = [np.asarray(v) for v in vars(record.value).values() if isinstance(v, np.ndarray)]
        assert len({len(column) for column in columns}) == 1
        assert all(np.isfinite(column).all() for column in columns)
    assert reader.damage.n_read <= n


def test_the_walk_holds_only_a_part_of_the_file(tmp_path):
    """Whatever the file's length, a few megabytes; whatever its frames, some thousand packages at once."""
    path = tmp_path / "long.lvx"
    data = recording(path, n_frames=2, per=8)
    start = LAYOUTS["1.1"].data_start(1)
    bodies = b"".join(data[a:b] for a, b, *_, imu in packages(data) if not imu)
    with path.open("wb") as file:
        file.write(data[:start])
        for _ in range(700):
            file.write(bodies)
    with path.open("rb") as file:
        walk = Walk(file, PackageTest(LAYOUTS["1.1"]), start)
        counts, held = [], 0
        for frame in walk.frames():
            counts.append(len(frame.packages))
            held = max(held, len(walk._data))
    assert sum(counts) == 700 * 16 and max(counts) <= 4_096 and held < 6 << 20
    assert path.stat().st_size > 14 << 20
