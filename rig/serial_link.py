"""The line to the microcontroller: found, read and written without waiting, opened again after an unplug.

Which protocol the device speaks is heard, not asked: the host listens to both, and takes the one in which
three messages have come. It says nothing before that, or before two seconds in which nothing came at all;
then it speaks plain lines, and a framed device ignores them. To a device that talks and is not understood, as
a receiver for satellites, it never says anything.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from acino_fte.errors import InputError
from acino_fte.rig.gpio import missing_rig_package
from acino_fte.rig.serial_frames import FramedLines, Lines, LinkCounts, Message, PlainLines

BAUD = 115_200
RETRY_NS = 500_000_000
"""Between two attempts to open a port that is gone."""
LISTEN_NS = 2_000_000_000
"""Silence after which plain lines are spoken."""
_HEARD = 3  # messages of one protocol


class Port(Protocol):
    """A serial port; every method raises OSError when it is gone."""

    def read(self) -> bytes:
        """What has come; never waits."""

    def write(self, data: bytes) -> None:
        """Send; never waits long."""

    def close(self) -> None:
        """Close."""


class SerialPort:
    """A port of this computer, by pyserial: 115200 baud, 8N1, for this program alone.

    Parameters
    ----------
    path : str
        Device.
    """

    def __init__(self, path: str) -> None:
        try:
            import serial
        except ImportError as error:
            raise missing_rig_package("Serial ports", error) from None
        self.path = path
        try:
            self._serial = serial.Serial(path, BAUD, timeout=0, write_timeout=0.05, exclusive=True)
        except OSError:
            raise
        except Exception as error:  # noqa: BLE001 - a cable pulled just now raises termios.error, which is none
            raise OSError(str(error)) from None

    def read(self) -> bytes:
        """What has come."""
        return bytes(self._serial.read(4096))

    def write(self, data: bytes) -> None:
        """Send."""
        self._serial.write(data)

    def close(self) -> None:
        """Close."""
        self._serial.close()


class SerialLink:
    """Messages to and from the microcontroller.

    Parameters
    ----------
    opener : callable
        Opens the port, or raises OSError or InputError while there is none.
    motors : tuple of int
        Numbers of the motors.
    framed : bool, optional
        Protocol; by default what the device is heard to speak.
    """

    def __init__(
        self, opener: Callable[[], Port], motors: tuple[int, ...] = (1, 2), *, framed: bool | None = None
    ) -> None:
        self._opener = opener
        self._candidates: list[Lines] = [FramedLines("host", motors), PlainLines("host", motors)]
        self._lines: Lines | None = None if framed is None else self._candidates[0 if framed else 1]
        self._port: Port | None = None
        self._tried_ns: int | None = None
        self._byte_ns = 0
        self.heard_ns: int | None = None
        self.interruptions = 0
        self.trouble = "not opened yet"

    @property
    def connected(self) -> bool:
        """Whether the port is open."""
        return self._port is not None

    @property
    def ready(self) -> bool:
        """Whether commands can be sent."""
        return self.connected and self._lines is not None

    @property
    def foreign(self) -> bool:
        """Whether something comes, and none of it is a message."""
        junk = min(lines.counts.refused for lines in self._candidates)
        return self.ready is False and self.heard_ns is None and junk >= _HEARD

    @property
    def protocol(self) -> str:
        """``"framed"``, ``"plain"``, or empty as long as it is not known."""
        return self._lines.name if self._lines else ""

    @property
    def counts(self) -> LinkCounts:
        """What came over the line."""
        return (self._lines or self._candidates[0]).counts

    def poll(self, now_ns: int) -> list[Message]:
        """Messages that have come; opens the port again when it was gone.

        Parameters
        ----------
        now_ns : int
            By the clock of the loop (monotonic).
        """
        if self._port is None and not self._open(now_ns):
            return []
        try:
            data = self._port.read() if self._port else b""
        except OSError as error:
            self._lose(error)
            return []
        messages = self._understand(data, now_ns)
        if messages:
            self.heard_ns = now_ns
        return messages

    def send(self, message: Message) -> bool:
        """Send a message; whether it could be."""
        if self._port is None or self._lines is None:
            return False
        try:
            self._port.write(self._lines.encode(message))
        except OSError as error:
            self._lose(error)
            return False
        return True

    def close(self) -> None:
        """Close the port."""
        if self._port is not None:
            with suppress(OSError):
                self._port.close()
        self._port = None

    def _understand(self, data: bytes, now_ns: int) -> list[Message]:
        if self._lines is not None:
            return self._lines.feed(data, now_ns)
        messages: list[Message] = []
        for lines in self._candidates:
            messages += lines.feed(data, now_ns)
            if lines.counts.accepted >= _HEARD and self._lines is None:
                self._lines = lines
        if data:
            self._byte_ns = now_ns
        silent = not messages and self.heard_ns is None and now_ns - self._byte_ns >= LISTEN_NS
        if self._lines is None and silent:
            self._lines = self._candidates[1]
        return messages

    def _open(self, now_ns: int) -> bool:
        if self._tried_ns is not None and 0 <= now_ns - self._tried_ns < RETRY_NS:
            return False
        self._tried_ns = now_ns
        try:
            self._port = self._opener()
        except (OSError, InputError) as error:
            self.trouble = _short(error)
            return False
        self.trouble = ""
        self._byte_ns = now_ns
        for lines in self._candidates:
            lines.interrupted()
        return True

    def _lose(self, error: OSError) -> None:
        self.close()
        self.interruptions += 1
        self.trouble = _short(error)


def find_port(folder: Path = Path("/dev/serial/by-id")) -> str:
    """The one serial port that a microcontroller is plugged into.

    Its name by serial number, where the system has one: it stays the same when the cable is plugged in again.

    Raises
    ------
    InputError
        There is none, or there are several.
    """
    try:
        from serial.tools.list_ports import comports
    except ImportError as error:
        raise missing_rig_package("Serial ports", error) from None
    by_id = {str(path.resolve()): str(path) for path in sorted(folder.glob("*"))} if folder.is_dir() else {}
    found = sorted(by_id.get(port.device, port.device) for port in comports() if port.vid is not None)
    if len(found) == 1:
        return found[0]
    raise InputError(
        "There are several serial ports." if found else "No microcontroller is plugged in.",
        expected="one serial port on USB",
        found=", ".join(found) or "none",
        remedy="name it: --port DEVICE" if found else "plug it in, or try with --simulate",
    )


def open_port(path: str | None) -> Port:
    """A serial port of this computer; without a path the one that there is."""
    return SerialPort(path or find_port())


def _short(error: Exception) -> str:
    """What went wrong, without the address of it."""
    if isinstance(error, InputError):
        return error.problem.removesuffix(".") + (f": {error.remedy}" if error.remedy else "")
    text = getattr(error, "strerror", None) or str(error)
    return text.split("\n")[0]
