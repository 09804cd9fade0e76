"""Pickles inside other tools' files, read so that they can hold data and nothing else.

A pickle is a program: it may name any function and have it called. Here only the names of containers,
numbers, text and of NumPy's and pandas' data classes are let through. The lists and numbers of ruamel.yaml,
which DeepLabCut copies from its configuration into its results, become plain ones by classes that stand in
for its own; the library itself is never looked up.
"""

from __future__ import annotations

import io
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np

from acino_fte.errors import InputError

_BUILTINS = (
    *("bool", "bytes", "complex", "dict", "float", "frozenset", "int", "list", "object"),
    *("set", "slice", "str", "tuple"),
)
_MULTIARRAY = ("_reconstruct", "scalar")
_NUMPY_CORE = re.compile(r"^numpy\.(core|_core)\.")  # NumPy 2 renamed it: files of both are read with both
_CORE = "numpy._core." if hasattr(np, "_core") else "numpy.core."
_INDEXES = {"base": "Index", "multi": "MultiIndex", "range": "RangeIndex", "datetimes": "DatetimeIndex"}

ALLOWED: frozenset[tuple[str, str]] = frozenset(
    [(module, name) for module in ("builtins", "__builtin__") for name in _BUILTINS]
    + [(f"numpy.{core}.multiarray", name) for core in ("core", "_core") for name in _MULTIARRAY]
    + [(f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")]
    + [("numpy", "ndarray"), ("numpy", "dtype"), ("_codecs", "encode"), ("copy_reg", "_reconstructor")]
    + [("copyreg", "_reconstructor"), ("collections", "OrderedDict")]
    + [(f"pandas.core.indexes.{module}", name) for module, name in _INDEXES.items()]
    + [("pandas.core.indexes.base", "_new_Index"), ("pandas.core.indexes.frozen", "FrozenList")]
    + [("pandas.core.frame", "DataFrame"), ("pandas.core.series", "Series")]
    + [("pandas", "Index"), ("pandas", "MultiIndex"), ("pandas", "DataFrame"), ("pandas", "Series")]
    + [("pandas", "RangeIndex"), ("pandas.core.internals.managers", "BlockManager")]
    + [("pandas.core.internals.managers", "SingleBlockManager")]
    + [("pandas._libs.internals", "_unpickle_block")]
    + [("pandas._libs.arrays", "__pyx_unpickle_NDArrayBacked")]
    + [("pandas.core.arrays.string_", name) for name in ("StringDtype", "StringArray")]
    + [("pandas", "StringDtype"), ("pandas.arrays", "StringArray")]
)

_BROKEN = (  # what it ends with depends on where a pickle is broken; NumPy's own code raises most of these
    pickle.UnpicklingError,
    ArithmeticError,
    AttributeError,
    EOFError,
    ImportError,
    LookupError,
    MemoryError,
    RuntimeError,
    SyntaxError,
    SystemError,
    TypeError,
    ValueError,
)


class _Forbidden(pickle.UnpicklingError):
    """The pickle names something that is not data."""


class _Inert:
    """Takes the place of a class of ruamel.yaml; whatever it is given besides its value is forgotten."""

    def __setstate__(self, state: Any) -> None:
        pass


class _List(_Inert, list):
    pass


class _Dict(_Inert, dict):
    pass


class _Float(_Inert, float):
    pass


class _Int(_Inert, int):
    pass


_STAND_INS: dict[str, type] = {
    **{"CommentedSeq": _List, "CommentedMap": _Dict, "ScalarFloat": _Float, "ScalarInt": _Int},
    **dict.fromkeys(("Format", "LineCol", "Comment", "CommentToken", "StringMark", "FileMark"), _Inert),
}


class _DataUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if module.startswith("ruamel.yaml.") and name in _STAND_INS:
            return _STAND_INS[name]
        if (module, name) not in ALLOWED:
            raise _Forbidden(f"{module}.{name}")
        return super().find_class(_NUMPY_CORE.sub(_CORE, module), name)

    def persistent_load(self, pid: Any) -> Any:
        raise _Forbidden(f"a reference to something outside ({pid!r})")


def load_data_pickle(data: bytes, *, file: Path | str, key: str | None = None) -> Any:
    """Unpickle data; nothing but the names in :data:`ALLOWED` is looked up, so no code can be run.

    Parameters
    ----------
    data : bytes
        The pickle; strings of Python 2 are taken as Latin-1.
    file, key
        Where it comes from, for error messages.

    Raises
    ------
    InputError
        The pickle names anything else, or it is broken.
    """
    try:
        return _DataUnpickler(io.BytesIO(data), encoding="latin1").load()
    except _Forbidden as error:
        raise InputError(
            "The file holds a pickle that is not plain data; it was not opened, because it could run code.",
            file=file,
            key=key,
            expected="numbers, text, lists, NumPy arrays, pandas tables",
            found=str(error),
            remedy="save it as CSV with the tool that wrote it, if you trust where it comes from",
        ) from None
    except _BROKEN as error:
        raise InputError(
            "The file holds a pickle that is broken.",
            file=file,
            key=key,
            found=f"{type(error).__name__}: {error}",
            remedy="write the file again, or save it as CSV",
        ) from None
