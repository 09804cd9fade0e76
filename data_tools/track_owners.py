"""Which camera a file of tracks belongs to, by name and never by order.

A file is called as its camera, or has its name as whole words: ``tracks_i_0_cut.pkl`` is of ``i_0_cut``.
``cam11.csv`` is not of ``cam1``; and of ``top`` and ``left_top`` the longer name wins. Two names side by side
say nothing, so that is an error, and so is a file that fits no camera or a camera with two files.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from acino_fte.data_tools.track_names import cameras_of
from acino_fte.errors import InputError


def owners(name: str, cameras: Sequence[str]) -> list[str]:
    """The cameras that a name may mean: one when it is clear, none, or several when it is ambiguous.

    Parameters
    ----------
    name : str
        Of a file without its ending, of a folder, or what a column says.
    cameras : sequence of str
        Their names.
    """
    exact = [c for c in cameras if c == name] or [c for c in cameras if _key(c) == _key(name)]
    if exact:
        return exact
    spans = [(span, c) for c in cameras if not c.isdigit() for span in _places(c, name)]
    longest = {c for span, c in spans if not any(_inside(span, other) for other, _ in spans)}
    found = [c for c in cameras if c in longest]
    if found:
        return found
    return cameras_of(name, cameras) or [
        c for c in cameras if c.isdigit() and re.search(rf"^0*{int(c)}_|_0*{int(c)}$", _key(name))
    ]


def owner(name: str, cameras: Sequence[str], file: Path, found: Iterable[str]) -> str:
    """The one camera that a name means.

    Raises
    ------
    InputError
        None or several; the message lists what was found and the cameras.
    """
    choice = owners(name, cameras)
    if len(choice) == 1:
        return choice[0]
    raise InputError(
        f"'{name}' may belong to {' or '.join(choice)}."
        if choice
        else f"'{name}' belongs to no camera: tracks and cameras are joined by name.",
        file=file,
        expected=f"the name of one camera: {some(cameras)}",
        found=some(found),
        remedy="rename the file (or what the column camera says) after its camera, or move it away",
    )


def some(names: Iterable[str]) -> str:
    """Names for a message, the first dozen of them."""
    names = list(names)
    more = f", … ({len(names)})" if len(names) > 12 else ""
    return (", ".join(names[:12]) + more) or "nothing"


def _key(name: str) -> str:
    """Words of a name, divided by one underscore each."""
    return re.sub(r"[\W_]+", "_", name.casefold()).strip("_")


def _places(camera: str, name: str) -> list[tuple[int, int]]:
    """Where a camera's name stands in another name as whole words."""
    pattern = rf"(?<![^_]){re.escape(_key(camera))}(?![^_])"
    return [match.span() for match in re.finditer(pattern, _key(name))]


def _inside(span: tuple[int, int], other: tuple[int, int]) -> bool:
    return span != other and other[0] <= span[0] and span[1] <= other[1]
