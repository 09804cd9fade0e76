"""A page in the browser for work by hand: served on this computer only, for one browser, without a network.

:func:`serve_page` runs a `NiceGUI <https://nicegui.io>`_ page until it is done with::

    def build(session: PageSession) -> None:
        picture = session.share("picture.png", png_bytes, "image/png")
        ui.image(picture)
        ui.button("Done", on_click=lambda: session.finish())

    serve_page(build, title="Adjust markers")

`build` runs once for every tab that is opened (and again when a tab is loaded anew), so what the user did
belongs into an object outside of it. See :mod:`acino_fte.local_page_guard` for who may see the page.
"""

from __future__ import annotations

import json
import signal
import socket
import threading
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

from acino_fte.errors import InputError
from acino_fte.local_page_guard import Guard

HOST = "127.0.0.1"
REMEDY = 'pip install "acino-fte[lidar]"'
FAREWELL = "Done. You may close this tab."
Ending = Literal["done", "interrupted", "browser closed"]
_AWAY = 5.0  # s without any tab before the browser counts as closed: a tab that loads anew is back sooner
_served = threading.Lock()

_LOST = """
#popup[aria-hidden=false] { inset: 0; margin: auto; width: 32em; height: fit-content; max-width: 90vw }
#popup::after {
  content: "Do not go on here: if the program has ended, start it again. What you did before is saved." }
"""  # of the message when the connection is lost, which else is easily overlooked
_OVER = """
window.socket?.disconnect();
document.body.append(Object.assign(document.createElement('div'), {id: 'farewell', textContent: %s,
  style: 'position:fixed;inset:0;z-index:100000;background:#fff;color:#222;padding:25vh 1em 1em;' +
    'font:20px/1.6 system-ui,sans-serif;text-align:center;white-space:pre-line'}));
"""


@dataclass
class PageSession:
    """One page while it is served; what `build` gets.

    Attributes
    ----------
    title : str
        Of the tab.
    url : str
        Address of the page without its token.
    ending : str
        Why the page ended: ``"done"``, ``"interrupted"`` (Ctrl-C, or the process was asked to end) or
        ``"browser closed"``.
    """

    title: str
    url: str = ""
    ending: Ending = "interrupted"
    _files: dict[str, tuple[bytes | Callable[[], bytes], str]] = field(default_factory=dict)
    _endings: list[Callable[[], object]] = field(default_factory=list)
    _stop: Callable[[], None] = lambda: None

    def share(
        self,
        name: str,
        content: bytes | Callable[[], bytes],
        media_type: str = "application/octet-stream",
    ) -> str:
        """Offer bytes to the page (an image, an array), and return their address.

        Parameters
        ----------
        name : str
            Under which the page finds them; letters, digits, ``.``, ``-`` and ``_``.
        content : bytes or callable
            Bytes, or what makes them whenever they are asked for (in a thread of its own).
        media_type : str
            As ``image/png``.
        """
        self._files[name] = (content, media_type)
        return f"/files/{name}"

    def on_finish(self, action: Callable[[], object]) -> None:
        """Have something done when the page ends, however it ends (but by the death of the process)."""
        self._endings.append(action)

    def finish(self, farewell: str = FAREWELL, ending: Ending = "done") -> None:
        """End the page: every tab shows the farewell, and :func:`serve_page` returns."""
        from nicegui import core
        from nicegui.client import Client

        if core.loop is None:
            return
        self.ending = ending

        def end() -> None:
            for client in list(Client.instances.values()):
                client.run_javascript(_OVER % json.dumps(farewell))
            assert core.loop is not None
            core.loop.call_later(0.2, self._stop)  # the farewell is on its way by then

        core.loop.call_soon_threadsafe(end)


def show_error(error: InputError | str) -> None:
    """One clear message in the page, that stays until it is closed."""
    from nicegui import ui

    ui.notify(
        str(error),
        type="negative",
        position="top",
        timeout=0,
        multi_line=True,
        close_button="Close",
        classes="local-page-error",
    )


def serve_page(
    build: Callable[[PageSession], object],
    *,
    title: str,
    port: int = 0,
    open_browser: bool = True,
    on_ready: Callable[[str], object] | None = None,
    close_with_browser: bool = False,
) -> Ending:
    """Serve a page on 127.0.0.1 until it is done with.

    One page a process: NiceGUI keeps one application. Tests run it in a process of its own, or once in a
    thread.

    Parameters
    ----------
    build : callable
        Makes the page's elements (``nicegui.ui``); called with the :class:`PageSession` for every tab. An
        InputError that it raises is shown in the page.
    title : str
        Of the tab.
    port : int
        0 takes a free one.
    open_browser : bool
        Open the browser at the page.
    on_ready : callable, optional
        Called with the one-time address once the server answers; without it, the address is printed.
    close_with_browser : bool
        End when the last tab has been closed for some seconds.

    Returns
    -------
    str
        Why it ended: ``"done"``, ``"interrupted"`` (Ctrl-C) or ``"browser closed"``.

    Raises
    ------
    InputError
        NiceGUI is not installed, or the port is taken.
    """
    listener = _listen(port)
    session = PageSession(title)
    try:
        guard, server = _server(session, build, listener.getsockname()[1], close_with_browser)
    except BaseException:
        listener.close()
        raise
    address = f"{session.url}?token={guard.token}"

    def ready() -> None:
        (on_ready or _announce)(address)
        if open_browser:
            threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()

    server.ready = ready
    session._stop = lambda: setattr(server, "should_exit", True)
    try:
        with _asked_to_end(session._stop):
            server.run(sockets=[listener])
    except KeyboardInterrupt:
        session.ending = "interrupted"
    finally:
        listener.close()
        for action in session._endings:
            action()
    return session.ending


@contextmanager
def _asked_to_end(stop: Callable[[], None]) -> Iterator[None]:
    """Let SIGTERM and SIGHUP (a terminal that is closed) end the page as Ctrl-C does: all is tidied up."""
    names = [name for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    if threading.current_thread() is not threading.main_thread():
        names = []
    before = {name: signal.signal(getattr(signal, name), lambda *_: stop()) for name in names}
    try:
        yield
    finally:
        for name, handler in before.items():
            signal.signal(getattr(signal, name), handler)


def _listen(port: int) -> socket.socket:
    """A socket on this computer only."""
    listener = socket.socket()
    try:
        listener.bind((HOST, port))
    except (OSError, OverflowError) as error:
        listener.close()
        raise InputError(
            "The page cannot be served at this port.",
            key="--port",
            expected="a free port, or 0 for any",
            found=f"{port}: {error}",
            remedy="leave --port away",
        ) from error
    return listener


def _server(
    session: PageSession, build: Callable[[PageSession], object], port: int, close_with_browser: bool
) -> tuple[Guard, Any]:
    """The guarded application and its server."""
    try:
        import nicegui  # noqa: F401
        import uvicorn
    except ImportError as error:
        raise InputError(
            "The page needs NiceGUI.", expected="the extra 'lidar'", found=str(error), remedy=REMEDY
        ) from error
    if not _served.acquire(blocking=False):
        raise RuntimeError("a process serves one page: NiceGUI keeps one application")

    class Server(uvicorn.Server):
        ready: Callable[[], None] = staticmethod(lambda: None)

        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets)
            if self.started:
                self.ready()

    session.url = f"http://{HOST}:{port}/"
    guard = Guard(_application(session, build), port)
    if close_with_browser:
        _follow_browser(session)
    config = uvicorn.Config(
        guard,
        log_level="error",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=1,
    )
    return guard, Server(config)


def _application(session: PageSession, build: Callable[[PageSession], object]) -> Any:
    """NiceGUI's application, with the shared files beside it."""
    from fastapi import FastAPI, HTTPException, Response
    from nicegui import app as pages
    from nicegui import ui

    outer = FastAPI(openapi_url=None)

    @outer.get("/files/{name}")
    def shared(name: str) -> Response:
        if name not in session._files:
            raise HTTPException(404)
        content, media_type = session._files[name]
        return Response(content() if callable(content) else content, media_type=media_type)

    ui.run_with(
        outer,
        root=lambda: _build(session, build),
        title=session.title,
        language="en-US",
        show_welcome_message=False,
    )
    pages.on_exception(_show_unexpected)
    return outer


def _build(session: PageSession, build: Callable[[PageSession], object]) -> None:
    """The elements of one tab; wrong input is said in the page."""
    from nicegui import ui

    ui.add_css(".local-page-error .q-notification__message { white-space: pre-wrap; font-family: inherit }")
    ui.add_css(_LOST)
    try:
        build(session)
    except InputError as error:
        show_error(error)


def _show_unexpected(error: Exception) -> None:
    """Say it in every tab; the traceback is in the terminal."""
    from nicegui.client import Client

    text = (
        str(error) if isinstance(error, InputError) else f"Something went wrong: {error!r}. See the terminal."
    )
    for client in list(Client.instances.values()):
        with client:
            show_error(text)


def _follow_browser(session: PageSession) -> None:
    """End the page when its last tab has been closed for a while."""
    from nicegui import app as pages
    from nicegui import core
    from nicegui.client import Client

    def end_if_alone() -> None:
        if not any(client.has_socket_connection for client in Client.instances.values()):
            session.finish(ending="browser closed")

    def left() -> None:
        if core.loop is not None:
            core.loop.call_later(_AWAY, end_if_alone)

    pages.on_disconnect(left)


def _announce(address: str) -> None:
    """The address in the terminal."""
    from acino_fte.cli_common import stdout

    stdout.print(f"The page is at [bold cyan]{address}[/]")
    stdout.print("It opens once, in one browser on this computer. Ctrl-C here ends it.")
