"""One recorder for a rig: a file that the operating system lets only one process hold.

The system frees it when the process ends, however it ends. What the file says then tells whether the process
closed its recording, and which one it was.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from datetime import datetime
from hashlib import sha256
from pathlib import Path
from typing import IO, Any

from acino_fte.errors import InputError


class RigLock:
    """Held while a rig records: a context manager.

    Parameters
    ----------
    path : Path
        The file; it goes when the lock is let go, and stays where the process dies.
    recording : Path
        What is recorded, for whoever finds the lock.

    Attributes
    ----------
    taken_over : str
        One sentence where the recorder before died without closing; else empty.

    Raises
    ------
    InputError
        On entering: another recorder holds it, or the file cannot be made.
    """

    def __init__(self, path: Path, recording: Path) -> None:
        self.path, self.recording, self.taken_over = Path(path), Path(recording), ""
        self._file: IO[bytes] | None = None

    def __enter__(self) -> RigLock:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            file, held = _taken(self.path)
        except OSError as error:
            raise InputError(
                "The lock of the rig cannot be made.",
                file=self.path,
                found=error.strerror or str(error),
                remedy="where another user's recorder left it: remove the file",
            ) from None
        before = _content(file)
        if not held:
            file.close()
            raise InputError(
                "Another recorder has this rig.",
                file=self.path,
                found=_sentence(before) or "a process that does not say what it does",
                remedy="stop it first (Ctrl-C where it runs)",
            )
        if before:
            rescue = f"; acino-fte rig recover {before.get('recording', 'FOLDER')} rescues what it left"
            self.taken_over = f"the recorder before died without closing: {_sentence(before)}{rescue}"
        self._file = file
        with suppress(OSError):  # a full disk: it is held, and says nothing
            self._write(
                {"pid": os.getpid(), "since": datetime.now().isoformat(" ", "seconds"),
                 "recording": str(self.recording.resolve())}
            )  # fmt: skip
        return self

    def _write(self, content: dict[str, Any]) -> None:
        if self._file is not None:
            self._file.seek(0)
            self._file.truncate()
            self._file.write(json.dumps(content).encode() if content else b"")

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            with suppress(OSError):  # of another user's file: then it stays, empty
                self._write({})
                if os.name != "nt":
                    self.path.unlink()  # while it is held: see _taken
            self._file.close()
            self._file = None
            if os.name == "nt":
                with suppress(OSError):  # another recorder has it open
                    self.path.unlink()


def lock_path(folder: Path, rig: str) -> Path:
    """The lock of the rig of this name among those in a folder."""
    return folder / f"acino-fte-rig-{sha256(rig.encode()).hexdigest()[:12]}.lock"


def _taken(path: Path) -> tuple[IO[bytes], bool]:
    """The file and whether it could be held: the one that has its name now, not one just removed."""
    while True:
        file = _open(path)
        held = _hold(file)
        try:
            same = os.path.samestat(os.fstat(file.fileno()), path.stat())
        except FileNotFoundError:
            same = False
        if same:
            return file, held
        file.close()


def _open(path: Path) -> IO[bytes]:
    """Open the file, or make it for every user of the computer."""
    try:
        number = os.open(path, os.O_RDWR)
    except FileNotFoundError:
        number = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        with suppress(OSError):
            path.chmod(0o666)
    return os.fdopen(number, "r+b", buffering=0)


def _hold(file: IO[bytes]) -> bool:
    """Hold the file until this process ends or closes it; False where another one does."""
    try:
        if os.name == "nt":
            import msvcrt

            file.seek(1 << 20)  # beyond what it says, which others may read
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _content(file: IO[bytes]) -> dict[str, Any]:
    file.seek(0)
    try:
        found = json.loads(file.read(1 << 16) or b"{}")
    except ValueError:
        return {"pid": "unknown"}
    return found if isinstance(found, dict) else {"pid": "unknown"}


def _sentence(content: dict[str, Any]) -> str:
    if not content:
        return ""
    return (
        f"process {content.get('pid', '?')}, recording {content.get('recording', '?')} "
        f"since {content.get('since', '?')}"
    )
