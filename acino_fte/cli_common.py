"""What all commands share: consoles, errors turned into messages and exit codes, clock and spinner."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import typer
from rich.console import Console
from rich.markup import escape

from acino_fte.errors import InputError

EXIT_OTHER, EXIT_INPUT, EXIT_UNCONVERGED = 1, 2, 3

stdout = Console(highlight=False, soft_wrap=True)
stderr = Console(stderr=True, highlight=False, soft_wrap=True)


@contextmanager
def reported_errors() -> Iterator[None]:
    """Turn an InputError into its message on stderr and exit code 2; Ctrl-C into exit code 1."""
    try:
        yield
    except InputError as error:
        stderr.print(f"[bold red]error:[/] {escape(str(error))}")
        raise typer.Exit(EXIT_INPUT) from None
    except KeyboardInterrupt:
        stderr.print("[bold red]interrupted[/] before there was anything to save; nothing was written")
        raise typer.Exit(EXIT_OTHER) from None


def warn(message: str) -> None:
    """A warning on stderr."""
    stderr.print(f"[bold yellow]warning:[/] {escape(message)}")


def on_terminal() -> bool:
    """Whether progress should be shown."""
    return sys.stderr.isatty()


def chosen_formats(text: str, known: Sequence[str]) -> tuple[str, ...]:
    """The formats in a text with commas, in the order of the known ones; ``csv`` is always written.

    Raises
    ------
    InputError
        One of them is not known.
    """
    names = [name.strip().lower() for name in text.split(",") if name.strip()]
    wrong = [name for name in names if name not in (*known, "csv")]
    if wrong:
        raise InputError(
            "This format is not known.",
            key="--format",
            expected=f"some of csv, {', '.join(known)}, with commas between them",
            found=", ".join(wrong),
        )
    return tuple(name for name in known if name in names)


@dataclass
class Clock:
    """Seconds of every step; a step that comes again is added up."""

    seconds: dict[str, float] = field(default_factory=dict)
    _name: str = ""
    _begun: float = 0.0

    def begin(self, name: str) -> None:
        """End the step under way and begin another."""
        self.end()
        self._name, self._begun = name, time.perf_counter()

    def end(self) -> None:
        """End the step under way."""
        if self._name:
            passed = time.perf_counter() - self._begun
            self.seconds[self._name] = self.seconds.get(self._name, 0.0) + passed
        self._name = ""


@contextmanager
def spinner(quiet: bool) -> Iterator[Callable[[str], None]]:
    """The step under way and the time so far, on a terminal; nothing in a pipe."""
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    with Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        console=stderr,
        transient=True,
        disable=quiet or not on_terminal(),
    ) as bar:
        task = bar.add_task("", total=None)
        yield lambda text: bar.update(task, description=escape(text))
