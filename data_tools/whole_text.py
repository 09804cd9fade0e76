"""Text files written whole or not at all."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from secrets import token_hex

from acino_fte.errors import InputError


def write_text_whole(path: Path, text: str) -> None:
    """Write a text file whole or not at all, even when the process or the computer stops meanwhile.

    Raises
    ------
    InputError
        It cannot be written; what was there before is still there.
    """
    working = path.with_name(f".{path.name}.tmp-{token_hex(4)}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with working.open("w", encoding="utf-8", newline="") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        working.replace(path)
    except OSError as error:
        raise InputError(
            "The file cannot be written; what it held before is still there.",
            file=path,
            found=error.strerror or str(error),
            remedy="free some space, or choose another place with -o",
        ) from None
    finally:
        with suppress(OSError):  # of a folder that is none
            working.unlink(missing_ok=True)
