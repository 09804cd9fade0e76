"""DeepLabCut tables: CSV and H5 alike, and every way in which they can be wrong."""

import pickle

import h5py
import numpy as np
import pandas as pd
import pytest
from data_tools_synthetic import LILY, message, needs_lily

from acino_fte.data_tools.deeplabcut import read_deeplabcut, write_deeplabcut_csv
from acino_fte.data_tools.safe_pickle import load_data_pickle

NAMES = ["nose", "tail base", "l_eye"]
HEADER = "scorer,net,net,net\nbodyparts,nose,nose,nose\ncoords,x,y,likelihood\n"


def sample(n_frames=7):
    rng = np.random.default_rng(0)
    position = rng.uniform(1, 900, (n_frames, 3, 2)).round(3)
    likelihood = rng.uniform(0, 1, (n_frames, 3)).round(3)
    position[2, 1] = np.nan
    likelihood[2, 1] = 0.0
    return position, likelihood


def tuples(scorer="net"):
    return [(scorer, name, coordinate) for name in NAMES for coordinate in ("x", "y", "likelihood")]


def flat(position, likelihood):
    return np.concatenate([position, likelihood[..., None]], -1).reshape(len(position), -1)


def write_table_h5(path, values, columns, index=None, key="df_with_missing"):
    """The layout 'table' of pandas, as PyTables writes it."""
    with h5py.File(path, "w") as file:
        group = file.create_group(key)
        group.attrs["pandas_type"] = np.bytes_("frame_table")
        info = {1: {"names": ["scorer", "bodyparts", "coords"], "type": "MultiIndex"}, "index": {}}
        group.attrs["info"] = np.bytes_(pickle.dumps(info, 0))
        rows = np.zeros(len(values), [("index", "<i8"), ("values_block_0", "<f8", (values.shape[1],))])
        rows["index"] = np.arange(len(values)) if index is None else index
        rows["values_block_0"] = values
        table = group.create_dataset("table", data=rows)
        table.attrs["values_block_0_kind"] = np.bytes_(pickle.dumps(columns, 0))
    return path


def write_fixed_h5(path, values, columns, ragged=False):
    """The layout 'fixed' of pandas; level names as text arrays, or as pickled objects in a ragged array."""
    with h5py.File(path, "w") as file:
        group = file.create_group("df_with_missing")
        group.attrs.update(
            {"pandas_type": np.bytes_("frame"), "nblocks": 1, "block0_items_nlevels": len(columns[0])}
        )
        group.create_dataset("axis1", data=np.arange(len(values)))
        group.create_dataset("block0_values", data=values).attrs["transposed"] = np.uint8(1)
        for i, name in enumerate(("scorer", "bodyparts", "coords")):
            level, codes = np.unique([c[i] for c in columns], return_inverse=True)
            group.create_dataset(f"block0_items_label{i}", data=codes.astype(np.int8))
            if ragged:
                stored = group.create_dataset(f"block0_items_level{i}", (1,), dtype=h5py.vlen_dtype(np.uint8))
                stored[0] = np.frombuffer(pickle.dumps(level.astype(object), 5), np.uint8)
            else:
                stored = group.create_dataset(f"block0_items_level{i}", data=level.astype("S"))
            stored.attrs["name"] = np.bytes_(name)
    return path


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return path


def same(a, b):
    assert a.names == b.names
    np.testing.assert_array_equal(a.position, b.position)
    np.testing.assert_array_equal(a.likelihood, b.likelihood)


def test_csv_round_trip(tmp_path):
    position, likelihood = sample()
    write_deeplabcut_csv(tmp_path / "a.csv", NAMES, position, likelihood, scorer="x", decimals=3)
    read = read_deeplabcut(tmp_path / "a.csv")
    assert read.names == tuple(NAMES)
    assert read.n_frames == 7
    np.testing.assert_array_equal(read.position, position)
    np.testing.assert_array_equal(read.likelihood, likelihood)
    np.testing.assert_array_equal(read.x, position[..., 0])
    np.testing.assert_array_equal(read.y, position[..., 1])
    frame = pd.read_csv(tmp_path / "a.csv", header=[0, 1, 2], index_col=0)  # as DeepLabCut reads it
    assert frame.columns.names == ["scorer", "bodyparts", "coords"]
    assert frame.shape == (7, 9)


def test_writer_refuses_shapes_that_do_not_fit(tmp_path):
    position, likelihood = sample()
    error = message(write_deeplabcut_csv, tmp_path / "a.csv", NAMES[:2], position, likelihood)
    assert "(7, 3, 2)" in error.found


@pytest.mark.parametrize("layout", ["table", "fixed", "ragged"])
def test_h5_equals_csv(tmp_path, layout):
    position, likelihood = sample()
    write_deeplabcut_csv(tmp_path / "a.csv", NAMES, position, likelihood)
    values = flat(position, likelihood)
    if layout == "table":
        path = write_table_h5(tmp_path / "a.h5", values, tuples())
    else:
        path = write_fixed_h5(tmp_path / "a.h5", values, tuples(), ragged=layout == "ragged")
    read = read_deeplabcut(path)
    assert set(read.names) == set(NAMES)
    same(read, read_deeplabcut(tmp_path / "a.csv"))


@needs_lily
def test_h5_equals_csv_on_lily():
    for path in sorted((LILY / "dlc_h5").glob("*.h5")):
        same(read_deeplabcut(path), read_deeplabcut(LILY / "dlc" / (path.stem + ".csv")))


def test_rows_are_sorted_and_gaps_are_nan(tmp_path):
    read = read_deeplabcut(write(tmp_path / "a.csv", HEADER + "5,3,4,0.5\n2,1,2,0.9\n"))
    assert read.n_frames == 6
    np.testing.assert_array_equal(read.position[[2, 5], 0], [[1, 2], [3, 4]])
    assert np.isnan(read.position[[0, 1, 3, 4]]).all()
    assert (read.likelihood[[0, 1, 3, 4]] == 0).all()


def test_what_tools_write_for_nothing_found_is_nan(tmp_path):
    read = read_deeplabcut(write(tmp_path / "a.csv", HEADER + "0,0,0,0.9\n1,-1,-1,-1\n2,,,\n3,7,8,0.1\n"))
    assert np.isnan(read.position[:3]).all()
    np.testing.assert_array_equal(read.position[3, 0], [7, 8])
    np.testing.assert_array_equal(read.likelihood[:, 0], [0, 0, 0, 0.1])


def test_one_individual_windows_lines_and_a_byte_order_mark_are_fine(tmp_path):
    text = HEADER.replace("bodyparts", "individuals,cat,cat,cat\nbodyparts") + "0,1,2,0.9\n"
    path = tmp_path / "a.csv"
    path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    assert read_deeplabcut(path).names == ("nose",)


CASES = {
    "empty file": ("", "empty", "analyze_videos"),
    "header only": (HEADER, "no rows", "analyse the video again"),
    "other csv": ("a,b,c\n1,2,3\n", "not a DeepLabCut table", "analyze_videos"),
    "semicolons": (HEADER.replace(",", ";") + "0;1;2;0.9\n", "not a DeepLabCut table", "commas"),
    "cut line": (HEADER + "0,1,2,0.9\n1,2,\n", "line 5", "cut"),
    "cut header": ("scorer,net,net,net\nbodyparts,nose\n", "line 2", "cut"),
    "no coords": ("scorer,net\nbodyparts,nose\n0,1\n", "header row 'coords'", "analyze_videos"),
    "text cell": (HEADER + "0,1,2,0.9\n1,oops,2,0.9\n", "line 5, nose.x", "empty"),
    "image names": (HEADER + "img0.png,1,2,0.9\n", "line 4, the first column", "labelled images"),
    "frame twice": (HEADER + "0,1,2,0.9\n0,1,2,0.9\n", "Frame 0 has two rows", "remove"),
    "time stamps": (HEADER + "0.5,1,2,0.9\n", "does not count frames", "number the rows"),
    "wild frame numbers": (HEADER + "0,1,2,0.9\n99999999,1,2,0.9\n", "too many gaps", "number the rows"),
    "percentages": (HEADER + "0,1,2,97\n", "no probabilities", "divide them by 100"),
    "no likelihood": ("scorer,n,n\nbodyparts,a,a\ncoords,x,y\n0,1,2\n", "no likelihood", "likelihood"),
    "3D": ("scorer,n,n,n\nbodyparts,a,a,a\ncoords,x,y,z\n0,1,2,3\n", "3D result", "2D files"),
    "lacking y": (HEADER.replace("x,y,likelihood", "x,x2,likelihood") + "0,1,2,0.9\n", "lacks y", "export"),
    "part twice": (
        "scorer,n,n,n,n,n,n\nbodyparts,a,a,a,a,a,a\ncoords,x,y,likelihood,x,y,likelihood\n0,1,2,1,1,2,1\n",
        "'a' comes twice",
        "rename",
    ),
    "animals": (
        "scorer,n,n,n\nindividuals,a,b,b\nbodyparts,p,p,p\ncoords,x,y,likelihood\n0,1,2,1\n",
        "several animals",
        "one file per animal",
    ),
    "scorers": (HEADER.replace("net,net,net", "a,b,b") + "0,1,2,1\n", "several scorers", "one scorer"),
}


@pytest.mark.parametrize("case", CASES)
def test_faulty_csv(tmp_path, case):
    text, problem, remedy = CASES[case]
    error = message(read_deeplabcut, write(tmp_path / "cam1.csv", text))
    assert error.file.endswith("cam1.csv")
    assert problem in str(error)
    assert remedy in error.remedy


def test_files_of_other_kinds(tmp_path):
    assert "does not exist" in str(message(read_deeplabcut, tmp_path / "none.csv"))
    assert ".csv or .h5" in str(message(read_deeplabcut, write(tmp_path / "a.txt", "x")))
    assert "as text" in message(read_deeplabcut, _bytes(tmp_path / "a.csv", b"\xff\xfe\x00\x00")).problem
    error = message(read_deeplabcut, write(tmp_path / "a.h5", "not hdf5"))
    assert "a.h5" in error.file
    assert "CSV" in error.remedy


def _bytes(path, data):
    path.write_bytes(data)
    return path


def test_h5_without_or_with_several_tables(tmp_path):
    with h5py.File(tmp_path / "sleap.h5", "w") as file:
        file["tracks"] = np.zeros((1, 2, 3, 4))
    assert "0 tables among tracks" in message(read_deeplabcut, tmp_path / "sleap.h5").found
    path = write_table_h5(tmp_path / "two.h5", flat(*sample()), tuples(), key="a")
    with h5py.File(path, "a") as file:
        file.copy("a", "b")
    assert "2 tables" in message(read_deeplabcut, path).found
    with h5py.File(path, "a") as file:
        file.copy("a", "df_with_missing")
    assert read_deeplabcut(path).n_frames == 7


@pytest.mark.parametrize(
    ("columns", "found"),
    [
        (tuples()[:-1], "8|9 columns"),
        (
            [("n", "cat", *c[1:]) if i < 3 else ("n", "dog", *c[1:]) for i, c in enumerate(tuples())],
            "cat, dog",
        ),
        ([c[1] for c in tuples()], "columns named"),
    ],
)
def test_h5_with_other_columns(tmp_path, columns, found):
    error = message(read_deeplabcut, write_table_h5(tmp_path / "a.h5", flat(*sample()), columns))
    assert any(part in error.found for part in found.split("|"))
    assert error.file.endswith("a.h5")


def test_h5_of_labelled_images(tmp_path):
    path = write_table_h5(tmp_path / "a.h5", flat(*sample()), tuples())
    with h5py.File(path, "a") as file:
        rows = file["df_with_missing/table"][...]
        kinds = [("index", "S20"), ("values_block_0", "<f8", (9,))]
        kind = file["df_with_missing/table"].attrs["values_block_0_kind"]
        del file["df_with_missing/table"]
        named = np.zeros(len(rows), kinds)
        named["index"] = b"labeled/img0.png"
        file["df_with_missing/table"] = named
        file["df_with_missing/table"].attrs["values_block_0_kind"] = kind
    assert "img0.png" in message(read_deeplabcut, path).found


class _Evil:
    def __reduce__(self):
        return (eval, ("1",))


def test_h5_cannot_run_code(tmp_path):
    path = write_table_h5(tmp_path / "a.h5", flat(*sample()), tuples())
    with h5py.File(path, "a") as file:
        file["df_with_missing/table"].attrs["values_block_0_kind"] = np.bytes_(pickle.dumps(_Evil(), 0))
    error = message(read_deeplabcut, path)
    assert "could run code" in error.problem
    assert "eval" in error.found
    assert error.key == "values_block_0_kind"


@pytest.mark.parametrize("protocol", [0, 2, 5])
@pytest.mark.parametrize(
    "value",
    [
        {"a": [1, 2.5, None, ("x", b"y")], "s": {1}},
        np.arange(6.0).reshape(2, 3),
        np.float64(3),
        np.array(["a", None], dtype=object),
        pd.Index(["a", "b"]),
        pd.MultiIndex.from_tuples([("a", "x"), ("a", "y")]),
        pd.DataFrame({"a": [1.0, 2.0], "b": ["x", "y"]}),
    ],
    ids=lambda v: type(v).__name__,
)
def test_data_pickles_are_read(value, protocol):
    assert repr(load_data_pickle(pickle.dumps(value, protocol), file="f")) == repr(value)


@pytest.mark.parametrize(
    "data",
    [
        b"cos\nsystem\n(S'true'\ntR.",
        b"cbuiltins\neval\n.",
        b"cnumpy\nload\n.",
        b"cpandas\nread_pickle\n.",
        b"P1\n.",
    ],
)
def test_pickles_of_other_things_are_refused(data):
    assert "could run code" in message(load_data_pickle, data, file="f", key="k").problem


@pytest.mark.parametrize("data", [b"", b"junk", b"(lp0\n", pickle.dumps([1, 2])[:-3]])
def test_broken_pickles(data):
    assert "broken" in message(load_data_pickle, data, file="f").problem
