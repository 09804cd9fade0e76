"""Messages of ROS 1 and ROS 2 as bytes: read and written by their definitions, in three layouts.

``rosbags`` parses the definitions. The bytes are handled here for two reasons: rosbag2 under eCAL writes a
layout that ``rosbags`` does not know, and a lidar's message has thousands of points, which are read as one
array here.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from acino_fte.extras import missing_package

BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
"""Kinds of fields, as ``rosbags`` numbers them."""
_CODES = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "octet": "u1",
    **{f"{sign}int{8 * n}": f"{code}{n}" for sign, code in (("", "i"), ("u", "u")) for n in (1, 2, 4, 8)},
    "float32": "f4",
    "float64": "f8",
}
_STRUCT = dict(zip(("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"), "bBhHiIqQfd", strict=True))
_EXCESS = 7
"""Bytes that a writer may leave after a message to pad it."""

Types = dict[str, list[tuple[str, Any]]]
"""Fields of each type by name: (name, description)."""


class DecodeError(Exception):
    """The bytes are not a message of this definition."""


@dataclass(frozen=True)
class Layout:
    """How a message becomes bytes.

    Attributes
    ----------
    name : str
    aligned : bool
        Numbers stand at multiples of their size.
    count : str
        Code of the count before a string or a sequence.
    terminated : bool
        A string ends with a zero byte, which its count includes.
    head : int
        Bytes before the message: the encapsulation of CDR.
    """

    name: str
    aligned: bool
    count: str
    terminated: bool
    head: int


ROS1 = Layout("ros1", False, "I", False, 0)
CDR = Layout("cdr", True, "I", True, 4)
CUSTOM = Layout("custom", False, "Q", False, 0)
"""rosbag2 under eCAL: fields in order, native little-endian, no alignment, no head, counts of 8 bytes."""
LAYOUTS = {layout.name: layout for layout in (ROS1, CDR, CUSTOM)}


@lru_cache(maxsize=256)
def definitions(name: str, text: str, version: int, encoding: str = "ros2msg") -> Types:
    """Fields of a message type and of all types in it.

    Parameters
    ----------
    name : str
        ``package/msg/Type``.
    text : str
        The definition as the bag has it; empty where it has none: the standard one is taken.
    version : int
        Of ROS, 1 or 2: their headers differ.
    encoding : str
        ``ros2msg`` or ``ros2idl``.

    Raises
    ------
    DecodeError
        The definition is broken, or there is none.
    """
    from acino_fte.data_tools.ros_messages import DEFINITIONS

    types = dict(_standard(version))
    try:
        from rosbags.typesys import get_types_from_idl, get_types_from_msg

        for known, definition in DEFINITIONS.items():
            types |= {key: fields for key, (_, fields) in get_types_from_msg(definition, known).items()}
        if text:
            parse = get_types_from_idl if encoding == "ros2idl" else get_types_from_msg
            found = parse(text) if encoding == "ros2idl" else parse(text, name)  # type: ignore[call-arg]
            types |= {key: fields for key, (_, fields) in found.items()}
    except Exception as error:  # noqa: BLE001 - whatever a broken definition makes the parser raise
        raise DecodeError(f"its definition cannot be read ({error})") from error
    if name not in types:
        raise DecodeError("the bag has no definition of it")
    return types


@lru_cache(maxsize=2)
def _standard(version: int) -> Types:
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise missing_package("Bags", error) from error
    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    return {name: fields for name, (_, fields) in store.fielddefs.items()}


def decode(data: bytes | memoryview, name: str, types: Types, layout: Layout) -> dict[str, Any]:
    """Read one message.

    Returns
    -------
    dict
        Values by field: numbers, strings, dicts of nested messages, arrays of numbers, structured arrays of
        messages of constant size, lists of others.

    Raises
    ------
    DecodeError
        Bytes are missing or left over, or a text is none.
    """
    view = memoryview(data)
    try:
        reader = _Reader(view, types, layout)
        message = reader.message(name)
    except (struct.error, ValueError, KeyError, IndexError, RecursionError, OverflowError) as error:
        raise DecodeError(f"its {len(view)} bytes do not fit its definition ({error})") from error
    if not 0 <= len(reader.data) - reader.at <= _EXCESS:
        raise DecodeError(f"{len(reader.data) - reader.at} bytes are left over")
    return message


class _Reader:
    """A place in the bytes of a message."""

    def __init__(self, data: memoryview, types: Types, layout: Layout) -> None:
        self.order = "<"
        if layout.head:
            if len(data) < layout.head or data[1] not in (0, 1):
                raise DecodeError("it has no CDR head")
            self.order = "<" if data[1] == 1 else ">"
        self.data, self.types, self.layout, self.at = data[layout.head :], types, layout, 0

    def message(self, name: str) -> dict[str, Any]:
        return {field: self.value(description) for field, description in self.types[name]}

    def value(self, description: Any) -> Any:
        kind, what = int(description[0]), description[1]
        if kind == BASE:
            return self.string() if what[0] in ("string", "wstring") else self.number(_CODES[what[0]])
        if kind == NAME:
            return self.message(what)
        count = what[1] if kind == ARRAY else self.count()
        return self.items(what[0], count)

    def number(self, code: str) -> int | float:
        size = int(code[1])
        start = self._align(size)
        self.at = start + size
        return struct.unpack_from(self.order + _STRUCT[code], self.data, start)[0]

    def count(self) -> int:
        return int(self.number("u4" if self.layout.count == "I" else "u8"))

    def string(self) -> str:
        n = self.count()
        raw = bytes(self._take(n))
        if self.layout.terminated and raw.endswith(b"\0"):
            raw = raw[:-1]
        return raw.decode("utf-8", "replace")

    def items(self, description: Any, count: int) -> Any:
        """`count` values one after another; as one array where their size is constant."""
        if count > len(self.data) - self.at:
            raise ValueError(f"a sequence of {count} items in {len(self.data) - self.at} bytes")
        kind, what = int(description[0]), description[1]
        if kind == BASE and what[0] in _CODES:
            dtype = _dtype(self.order + _CODES[what[0]])
            start = self._align(dtype.itemsize) if count else self.at
            self.at = start
            return np.frombuffer(self._take(count * dtype.itemsize), dtype)
        if kind == NAME and count > 1:
            packed = self._structures(what, count)
            if packed is not None:
                return packed
        return [self.value(description) for _ in range(count)]

    def _structures(self, name: str, count: int) -> np.ndarray | None:
        """Nested messages of constant size as a structured array."""
        first = _structure(self.types, name, self.order, self.layout.aligned)
        if first is None:
            return None
        dtype, size, alignment = first
        start = self._align(alignment)
        end = start + (count - 1) * dtype.itemsize + size
        if end > len(self.data):
            raise ValueError(f"{count} × {name} need {end - start} bytes, {len(self.data) - start} are left")
        raw = self.data[start : start + count * dtype.itemsize]
        if len(raw) < count * dtype.itemsize:  # the last one has no padding after it
            raw = memoryview(bytes(raw) + bytes(count * dtype.itemsize - len(raw)))
        self.at = end
        return np.frombuffer(raw, dtype, count)

    def _align(self, size: int) -> int:
        return self.at + (-self.at % size if self.layout.aligned else 0)

    def _take(self, n: int) -> memoryview:
        if self.at + n > len(self.data):
            raise ValueError(f"{n} bytes are needed, {len(self.data) - self.at} are left")
        self.at += n
        return self.data[self.at - n : self.at]


@lru_cache(maxsize=64)
def _dtype(code: str) -> np.dtype:
    return np.dtype(code)


def _structure(types: Types, name: str, order: str, aligned: bool) -> tuple[np.dtype, int, int] | None:
    """(dtype with its stride, bytes of the last one, alignment) of a flat message of numbers; else None.

    Where numbers are aligned, the first field must be of the largest size: every item begins alike then.
    """
    names, codes, offsets, at, largest = [], [], [], 0, 1
    for field, description in types[name]:
        kind, what = int(description[0]), description[1]
        if kind != BASE or what[0] not in _CODES:
            return None
        code = _dtype(order + _CODES[what[0]])
        at += -at % code.itemsize if aligned else 0
        names.append(field)
        codes.append(code)
        offsets.append(at)
        at += code.itemsize
        largest = max(largest, code.itemsize)
    if not names or (aligned and codes[0].itemsize != largest):
        return None
    alignment = largest if aligned else 1
    stride = at + (-at % alignment)
    dtype = np.dtype({"names": names, "formats": codes, "offsets": offsets, "itemsize": stride})
    return dtype, at, alignment


def encode(message: dict[str, Any], name: str, types: Types, layout: Layout) -> bytes:
    """Write one message, little-endian: the inverse of :func:`decode`."""
    out = bytearray()
    _write_message(out, message, name, types, layout)
    return (b"\0\1\0\0" if layout.head else b"") + bytes(out)


def _write_message(out: bytearray, message: Any, name: str, types: Types, layout: Layout) -> None:
    for field, description in types[name]:
        _write(out, message[field], description, types, layout)


def _write(out: bytearray, value: Any, description: Any, types: Types, layout: Layout) -> None:
    kind, what = int(description[0]), description[1]
    if kind == NAME:
        _write_message(out, value, what, types, layout)
    elif kind == BASE and what[0] == "string":
        raw = value.encode() + (b"\0" if layout.terminated else b"")
        _write_numbers(out, len(raw), layout.count == "I" and "u4" or "u8", layout)
        out += raw
    elif kind == BASE:
        _write_numbers(out, value, _CODES[what[0]], layout)
    else:
        if kind == SEQUENCE:
            _write_numbers(out, len(value), layout.count == "I" and "u4" or "u8", layout)
        item = what[0]
        packed = int(item[0]) == NAME and isinstance(value, np.ndarray)
        if int(item[0]) == BASE and item[1][0] in _CODES:
            _write_numbers(out, value, _CODES[item[1][0]], layout)
        elif packed and (shape := _structure(types, item[1], "<", layout.aligned)) is not None:
            _write_structures(out, value, *shape)
        else:
            for one in value:
                _write(out, one, item, types, layout)


def _write_numbers(out: bytearray, value: Any, code: str, layout: Layout) -> None:
    if isinstance(value, bytes | bytearray):
        value = np.frombuffer(value, "u1")
    array = np.asarray(value, dtype="<" + code)
    if layout.aligned and array.size:
        out += bytes(-len(out) % array.dtype.itemsize)
    out += array.tobytes()


def _write_structures(out: bytearray, value: np.ndarray, dtype: np.dtype, size: int, alignment: int) -> None:
    if len(value) == 0:
        return
    table = np.zeros(len(value), dtype)
    for field in dtype.names or ():
        table[field] = value[field]
    out += bytes(-len(out) % alignment)
    out += table.tobytes()[: (len(value) - 1) * dtype.itemsize + size]
