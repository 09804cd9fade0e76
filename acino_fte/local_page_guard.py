"""Who may see a local page: the browser that opened its one-time address, and nobody else on this computer.

A server on 127.0.0.1 can be reached by every program and every user of the computer, and by any web site that
the browser visits at the same time. The guard is plain ASGI and stands before everything, sockets included:

* The address carries a token that works once. It buys a cookie (``HttpOnly``, ``SameSite=Strict``).
* Without the cookie every request and every socket is refused.
* The ``Host`` must be this computer's own name (a foreign name that resolves to 127.0.0.1 is refused), and an
  ``Origin``, where there is one, must be the page itself; sockets must have one.
* Answers are not cached, and the page may load nothing from anywhere else (content security policy).
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from html import escape
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Message, Receive, Send], Awaitable[None]]

_POLICY_VIOLATION = 1008  # RFC 6455, section 7.4.1
_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>{head}
<body style="font:16px/1.5 system-ui,sans-serif;max-width:36em;margin:15vh auto;padding:0 1em">
<h1 style="font-size:1.4em">{title}</h1>{body}</body></html>"""
_SPENT = (
    "This address was opened already",
    "It works once, in one browser. Go on in that browser, or stop the program and start it again for a new "
    "address; what you did is saved.",
)
_WRONG = (
    "This page is private",
    "Open the address that the program printed in its terminal, with everything after the question mark.",
)
_ELSEWHERE = ("This page is private", "It answers to this computer only, at the address in the terminal.")


class Guard:
    """ASGI middleware that lets one browser in.

    Parameters
    ----------
    app : ASGI application
        What is guarded.
    port : int
        Of the server: part of the names it answers to, and of the cookie's name (cookies know no ports, so
        that two pages at once would log each other out).
    """

    def __init__(self, app: App, port: int) -> None:
        self.app = app
        self.token = secrets.token_urlsafe(32)
        self.cookie = f"acino_fte_{port}"
        self._secret = secrets.token_urlsafe(32)
        self._spent = False
        self._hosts = {f"{name}:{port}" for name in ("127.0.0.1", "localhost")}
        self._origins = {f"http://{host}" for host in self._hosts}
        sockets = " ".join(f"ws://{host}" for host in sorted(self._hosts))
        self._headers = [
            (b"cache-control", b"no-store"),
            (b"referrer-policy", b"no-referrer"),
            (b"x-content-type-options", b"nosniff"),
            (b"x-frame-options", b"DENY"),
            (b"cross-origin-resource-policy", b"same-origin"),
            (
                b"content-security-policy",
                "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; "
                "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
                f"worker-src 'self' blob:; connect-src 'self' {sockets}; object-src 'none'; "
                "base-uri 'none'; form-action 'self'; frame-ancestors 'none'".encode(),
            ),
        ]

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Pass a request on, answer it with the cookie, or refuse it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if not self._from_here(scope):
            await self._refuse(scope, receive, send, _ELSEWHERE)
        elif self._known(scope):
            await self.app(scope, receive, self._with_headers(send) if scope["type"] == "http" else send)
        elif (given := _token(scope)) is None or not hmac.compare_digest(given.encode(), self.token.encode()):
            await self._refuse(scope, receive, send, _WRONG)
        elif self._spent:
            await self._refuse(scope, receive, send, _SPENT)
        else:
            self._spent = True
            await self._welcome(send)

    def _from_here(self, scope: Message) -> bool:
        """Whether host and origin are the page's own."""
        headers = _headers(scope)
        if headers.get(b"host", b"").decode("latin-1").lower() not in self._hosts:
            return False
        origin = headers.get(b"origin")
        if origin is None:
            return scope["type"] == "http"
        return origin.decode("latin-1").lower() in self._origins

    def _known(self, scope: Message) -> bool:
        """Whether the request carries the cookie."""
        try:
            cookies = SimpleCookie(_headers(scope).get(b"cookie", b"").decode("latin-1"))
        except CookieError:
            return False
        morsel = cookies.get(self.cookie)
        return morsel is not None and hmac.compare_digest(morsel.value.encode(), self._secret.encode())

    async def _welcome(self, send: Send) -> None:
        """Hand out the cookie, and go to the page without the token.

        The page goes there by itself: a redirect that another site began would not carry the strict cookie.
        """
        head = "<script>location.replace('/')</script><noscript><a href='/'>Go on</a></noscript>"
        cookie = f"{self.cookie}={self._secret}; Path=/; HttpOnly; SameSite=Strict"
        body = _PAGE.format(title="Opening", head=head, body="").encode()
        await self._answer(send, 200, body, [(b"set-cookie", cookie.encode())])

    async def _refuse(self, scope: Message, receive: Receive, send: Send, why: tuple[str, str]) -> None:
        """Answer 403 with an explanation; a socket is closed before it opens."""
        if scope["type"] == "websocket":
            await receive()  # websocket.connect
            await send({"type": "websocket.close", "code": _POLICY_VIOLATION})
            return
        body = _PAGE.format(title=escape(why[0]), head="", body=f"<p>{escape(why[1])}</p>").encode()
        await self._answer(send, 403, body, [])

    async def _answer(self, send: Send, status: int, body: bytes, headers: list[tuple[bytes, bytes]]) -> None:
        own = [(b"content-type", b"text/html; charset=utf-8"), (b"content-length", str(len(body)).encode())]
        start = {"type": "http.response.start", "status": status, "headers": own + self._headers + headers}
        await send(start)
        await send({"type": "http.response.body", "body": body})

    def _with_headers(self, send: Send) -> Send:
        """A `send` that sets the guard's headers, in place of those the application set itself."""
        names = {name for name, _ in self._headers}

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                kept = [pair for pair in message.get("headers", ()) if bytes(pair[0]).lower() not in names]
                message = {**message, "headers": kept + self._headers}
            await send(message)

        return guarded


def _headers(scope: Message) -> dict[bytes, bytes]:
    return {bytes(name).lower(): bytes(value) for name, value in scope["headers"]}


def _token(scope: Message) -> str | None:
    """The token in the address of a page that is opened; other requests cannot spend it."""
    if scope["type"] != "http" or scope["method"] != "GET" or scope["path"] != "/":
        return None
    values = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token")
    return values[0] if values else None
