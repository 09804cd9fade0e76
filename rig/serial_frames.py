"""The lines between computer and microcontroller: bytes become messages, and nothing else does.

Plain, as rigs in the field speak it: ASCII, a message a line.

=======================  =====================================================================
``t<motor><speed>``      to the device: drive a motor, speed -800 … 800; 0 stops it
``reset``                to the device: stop both motors, set both counters to 0
``p<motor><count>``      from the device: counts of a motor's encoder
``r<motor><turns>``      from the device: the same in turns of the output shaft, decimal
=======================  =====================================================================

A motor's number is *one* digit, 1–9; what follows is the value. So ``t1200`` is motor 1 at 200, never motor
12; ``t1-200`` is motor 1 at -200. A value has one spelling: no ``+``, no leading zero, no ``-0``, no space.
What is spelt otherwise, or is out of range, is refused, never clipped.

Framed: ``$<seq><message>*<crc>``, for instance ``$05t1-200*2481``. `seq` counts the sender's lines modulo
256, two digits; `crc` is CRC-16/CCITT-FALSE (polynomial 0x1021, begins with 0xFFFF) of `seq` and message,
four digits; both hexadecimal with capitals. A receiver of framed lines refuses plain ones.
"""

from __future__ import annotations

import re
from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Literal

from acino_fte.errors import InputError

MAX_SPEED = 800
MAX_LINE = 40
"""Characters; the longest valid line has 28. What is longer is thrown away up to its end."""
MAX_COUNT = 2**31 - 1
RESYNC_NS = 200_000_000
"""After this long without an accepted frame any number is taken: the sender may have started again."""
_SPEED = re.compile(rb"t([1-9])(0|-?[1-9][0-9]{0,2})")
_COUNT = re.compile(rb"p([1-9])(0|-?[1-9][0-9]{0,9})")
_TURNS = re.compile(rb"r([1-9])(-?(?:0|[1-9][0-9]{0,5})(?:\.[0-9]{1,6})?)")
_FRAME = re.compile(rb"\$([0-9A-F]{2})([^*$]+)\*([0-9A-F]{4})")


@dataclass(frozen=True)
class Throttle:
    """Drive a motor."""

    motor: int
    speed: int


@dataclass(frozen=True)
class Reset:
    """Stop both motors, set both counters to 0."""


@dataclass(frozen=True)
class Count:
    """Counts of a motor's encoder."""

    motor: int
    count: int


@dataclass(frozen=True)
class Turns:
    """Turns of a motor's output shaft."""

    motor: int
    turns: float


Message = Throttle | Reset | Count | Turns
Side = Literal["device", "host"]


@dataclass
class LinkCounts:
    """What came over the line, counted.

    Attributes
    ----------
    accepted : int
        Messages.
    junk : int
        Lines that are none: damaged, unknown, spelt otherwise, for the other side, of an unknown motor.
    out_of_range : int
        Messages with an impossible value.
    overlong : int
        Lines of more than `MAX_LINE` characters.
    bad_crc : int
        Frames whose checksum is wrong.
    duplicates, out_of_order : int
        Frames with the number of the one before, or of an older one; ignored.
    lost : int
        Numbers that never came.
    """

    accepted: int = 0
    junk: int = 0
    out_of_range: int = 0
    overlong: int = 0
    bad_crc: int = 0
    duplicates: int = 0
    out_of_order: int = 0
    lost: int = 0

    @property
    def refused(self) -> int:
        """Lines that were not taken."""
        return sum(getattr(self, f.name) for f in fields(self)) - self.accepted - self.lost


class LineReader:
    """Bytes in pieces of any size → whole lines, without their end."""

    def __init__(self, counts: LinkCounts) -> None:
        self._counts = counts
        self._part = bytearray()
        self._skipping = False

    def feed(self, data: bytes) -> list[bytes]:
        """Lines that end in this piece; a carriage return before the end is left out."""
        *whole, rest = data.split(b"\n")
        lines = []
        for piece in whole:
            self._append(piece)
            if not self._skipping:
                lines.append(bytes(self._part.removesuffix(b"\r")))
            self._part.clear()
            self._skipping = False
        self._append(rest)
        return [line for line in lines if line]

    def clear(self) -> None:
        """Forget a line that was begun: the cable was out. Its rest alone is no message."""
        self._part.clear()
        self._skipping = False

    def _append(self, piece: bytes) -> None:
        if self._skipping:
            return
        self._part += piece
        if len(self._part) > MAX_LINE:
            self._counts.overlong += 1
            self._part.clear()
            self._skipping = True


class PlainLines:
    """The plain protocol, one side of it.

    Parameters
    ----------
    side : {"host", "device"}
        Whose messages are taken: a host takes counts and turns, a device commands.
    motors : tuple of int
        Numbers of the motors that there are.
    """

    name = "plain"

    def __init__(self, side: Side, motors: tuple[int, ...] = (1, 2)) -> None:
        self.counts = LinkCounts()
        self._side, self._motors = side, motors
        self._reader = LineReader(self.counts)

    def feed(self, data: bytes, now_ns: int = 0) -> list[Message]:
        """Messages that end in this piece of bytes."""
        taken = [self._take(line, now_ns) for line in self._reader.feed(data)]
        messages = [message for message in taken if message is not None]
        self.counts.accepted += len(messages)
        return messages

    def encode(self, message: Message) -> bytes:
        """A message as a line."""
        return body(message) + b"\n"

    def interrupted(self) -> None:
        """The cable was out: what was begun is not gone on with."""
        self._reader.clear()

    def _take(self, line: bytes, now_ns: int) -> Message | None:
        return self._message(line)

    def _message(self, text: bytes) -> Message | None:
        message = parse(text)
        if message is None or not self._is_for_us(message):
            self.counts.junk += 1
            return None
        if not in_range(message):
            self.counts.out_of_range += 1
            return None
        return message

    def _is_for_us(self, message: Message) -> bool:
        if isinstance(message, Reset):
            return self._side == "device"
        side = "device" if isinstance(message, Throttle) else "host"
        return side == self._side and message.motor in self._motors


class FramedLines(PlainLines):
    """The framed protocol, one side of it; see :class:`PlainLines`."""

    name = "framed"

    def __init__(self, side: Side, motors: tuple[int, ...] = (1, 2)) -> None:
        super().__init__(side, motors)
        self._sent = -1
        self._last: int | None = None
        self._accepted_ns = 0

    def encode(self, message: Message) -> bytes:
        """A message as the next frame."""
        self._sent = (self._sent + 1) % 256
        return frame(message, self._sent)

    def interrupted(self) -> None:
        """The cable was out: the other side may have started again."""
        super().interrupted()
        self._last = None

    def _take(self, line: bytes, now_ns: int) -> Message | None:
        match = _FRAME.fullmatch(line)
        if match is None:
            self.counts.junk += 1
            return None
        number, text, crc = match.groups()
        if crc_hqx(number + text, 0xFFFF) != int(crc, 16):
            self.counts.bad_crc += 1
            return None
        if not self._is_next(int(number, 16), now_ns):
            return None
        return self._message(text)

    def _is_next(self, number: int, now_ns: int) -> bool:
        """Whether this number follows; those between are lost."""
        if self._last is not None and now_ns - self._accepted_ns <= RESYNC_NS:
            ahead = (number - self._last) % 256
            if ahead == 0:
                self.counts.duplicates += 1
                return False
            if ahead >= 128:
                self.counts.out_of_order += 1
                return False
            self.counts.lost += ahead - 1
        self._last, self._accepted_ns = number, now_ns
        return True


Lines = PlainLines | FramedLines
MAKERS: dict[str, Callable[..., Lines]] = {"plain": PlainLines, "framed": FramedLines}


def parse(text: bytes) -> Message | None:
    """The message in a line; None if it is not spelt as one. Ranges are not checked."""
    if match := _SPEED.fullmatch(text):
        return Throttle(int(match[1]), int(match[2]))
    if match := _COUNT.fullmatch(text):
        return Count(int(match[1]), int(match[2]))
    if match := _TURNS.fullmatch(text):
        return Turns(int(match[1]), float(match[2]))
    return Reset() if text == b"reset" else None


def in_range(message: Message) -> bool:
    """Whether the value of a message is possible."""
    if isinstance(message, Throttle):
        return abs(message.speed) <= MAX_SPEED
    return not isinstance(message, Count) or -MAX_COUNT - 1 <= message.count <= MAX_COUNT


def body(message: Message) -> bytes:
    """The text of a message.

    Raises
    ------
    InputError
        Its value is out of range, or the motor's number has not one digit.
    """
    if isinstance(message, Reset):
        return b"reset"
    if not 1 <= message.motor <= 9 or not in_range(message):
        raise InputError(
            "This message cannot be sent.",
            expected=f"a motor 1–9, a speed of -{MAX_SPEED} … {MAX_SPEED}, counts of 32 bits",
            found=str(message),
        )
    if isinstance(message, Throttle):
        return b"t%d%d" % (message.motor, message.speed)
    if isinstance(message, Count):
        return b"p%d%d" % (message.motor, message.count)
    return f"r{message.motor}{message.turns:.4f}".encode()


def frame(message: Message, number: int) -> bytes:
    """A message as a framed line with this number, 0–255."""
    content = b"%02X" % number + body(message)
    return b"$%s*%04X\n" % (content, crc_hqx(content, 0xFFFF))
