"""What all commands share: the consoles, and errors turned into messages and exit codes."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

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
