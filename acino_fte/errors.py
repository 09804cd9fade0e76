"""The one exception for input that a user can mend."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path


class InputError(Exception):
    """Input is wrong; the message says where, what was expected, what was found and what to do.

    Commands print the message without a traceback and leave with exit code 2.

    Parameters
    ----------
    problem : str
        What is wrong, one sentence.
    file : Path or str, optional
        The file at fault.
    key : str, optional
        Where in the file (a key, a column, an argument).
    expected, found : str, optional
        Both sides of the mismatch.
    remedy : str, optional
        What to change.
    """

    def __init__(
        self,
        problem: str,
        *,
        file: Path | str | None = None,
        key: str | None = None,
        expected: str | None = None,
        found: str | None = None,
        remedy: str | None = None,
    ) -> None:
        self.problem = problem
        self.file = str(file) if file is not None else None
        self.key = key
        self.expected = expected
        self.found = found
        self.remedy = remedy
        super().__init__(self._message())

    def _message(self) -> str:
        lines = [self.problem]
        for label, text in (
            ("file", self.file),
            ("at", self.key),
            ("expected", self.expected),
            ("found", self.found),
            ("remedy", self.remedy),
        ):
            if text is not None:
                lines.append(f"  {label + ':':<10}{text}")
        return "\n".join(lines)


def did_you_mean(name: str, candidates: Iterable[str]) -> str:
    """Return ``"; did you mean 'head'?"`` for the nearest candidate, or an empty string."""
    by_lower = {c.lower(): c for c in candidates}
    near = get_close_matches(name.lower(), by_lower, n=1, cutoff=0.6)
    return f"; did you mean '{by_lower[near[0]]}'?" if near else ""
