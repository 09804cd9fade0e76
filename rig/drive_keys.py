"""Keys of a terminal, one by one and without waiting; the terminal is put back as it was."""

from __future__ import annotations

import os
import re
import select
import sys
from contextlib import suppress
from types import TracebackType
from typing import Any

from acino_fte.errors import InputError

_SEQUENCES = {
    "\x1b[A": "up",
    "\x1b[B": "down",
    "\x1b[C": "right",
    "\x1b[D": "left",
    "\x1bOA": "up",
    "\x1bOB": "down",
    "\x1bOC": "right",
    "\x1bOD": "left",
}
_BEGUN = re.compile(rb"\x1b(?:O|\[[0-9;?]*)?$")


def keys_in(text: str) -> list[str]:
    """Names of the keys in what a terminal sent: ``"left"``, ``"q"``, ``" "``; unknown ones are left out."""
    keys, place = [], 0
    while place < len(text):
        if text[place] != "\x1b":
            keys.append(text[place])
            place += 1
            continue
        name = _SEQUENCES.get(text[place : place + 3])
        if name:
            keys.append(name)
            place += 3
        else:
            place = _after_sequence(text, place)
    return keys


def _after_sequence(text: str, place: int) -> int:
    """Where an unknown escape sequence ends: at its first letter or tilde."""
    place += 1
    if place < len(text) and text[place] in "[O":
        place += 1
        while place < len(text) and not (text[place].isalpha() or text[place] == "~"):
            place += 1
        place += 1
    return place


class Keyboard:
    """The keys of this terminal, while it is entered. Ctrl-C still interrupts."""

    def __init__(self) -> None:
        self._before: list[Any] | None = None
        self._fd = -1
        self._begun = b""

    def __enter__(self) -> Keyboard:
        if not (sys.stdin.isatty() and sys.stdout.isatty()):
            raise InputError(
                "The rig is driven from a terminal, and this is none.",
                remedy="start it in a terminal; for a look without one: acino-fte rig drive --status",
            )
        try:
            import termios
            import tty
        except ImportError:
            raise InputError("Driving needs a terminal of Linux or macOS.", found=sys.platform) from None
        self._fd = sys.stdin.fileno()
        self._before = termios.tcgetattr(self._fd)
        tty.setcbreak(self._fd)
        raw = termios.tcgetattr(self._fd)
        raw[0] &= ~termios.IXON  # Ctrl-S would hold up the screen, and with it the loop
        termios.tcsetattr(self._fd, termios.TCSANOW, raw)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        import termios

        if self._before is not None:
            with suppress(termios.error):  # of a terminal that was closed
                termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)

    def read(self) -> list[str]:
        """Keys since the last time; ``"q"`` when the terminal is gone."""
        begun, self._begun = self._begun, b""
        if not select.select([self._fd], [], [], 0)[0]:
            return ["escape"] if begun == b"\x1b" else []
        data = os.read(self._fd, 1024)
        if not data:
            return ["q"]
        whole, self._begun = split_keys(begun + data)
        return keys_in(whole.decode("utf-8", "replace"))


def split_keys(data: bytes) -> tuple[bytes, bytes]:
    """What is whole, and the beginning of an escape sequence whose rest has not come yet."""
    begun = _BEGUN.search(data)
    return (data[: begun.start()], data[begun.start() :]) if begun else (data, b"")
