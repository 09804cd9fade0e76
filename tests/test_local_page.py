"""A local page: who gets in, what is refused, and how it ends."""

import http.client
import signal
import socket
import time

import pytest
from browser import browser, served, tab  # noqa: F401

from acino_fte.errors import InputError

pytest.importorskip("nicegui", reason="the extra 'lidar' is not installed")
from acino_fte.local_page import serve_page  # noqa: E402

PAGE = """
from nicegui import ui
from acino_fte.errors import InputError
from acino_fte.local_page import serve_page

def wrong():
    raise InputError("The file is missing.", remedy="look for it")

def build(session):
    count = ui.label("0")
    ui.button("Add", on_click=lambda: count.set_text(str(int(count.text) + 1)))
    ui.button("Wrong", on_click=wrong)
    ui.button("Done", on_click=lambda: session.finish("Saved to out"))
    ui.label(session.share("numbers", b"12345"))
    session.on_finish(lambda: print("tidied", flush=True))

print(serve_page(build, title="Work", open_browser=False), flush=True)
"""


@pytest.fixture(scope="module")
def server():
    with served("-c", PAGE) as running:
        yield running


def ask(server, path="/", method="GET", **headers):
    """Status, headers and body of one request."""
    host = server.url.split("/")[2]
    connection = http.client.HTTPConnection(host, timeout=5)
    connection.putrequest(method, path, skip_host=True)
    for name, value in ({"Host": host} | headers).items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read().decode()
    connection.close()
    return answer.status, dict(answer.getheaders()), body


def upgrade(server, **headers):
    """Status of the handshake of a socket (RFC 6455, section 4.1)."""
    key = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    key["Sec-WebSocket-Key"] = "AAAAAAAAAAAAAAAAAAAAAA=="
    path = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
    return ask_upgrade(
        server, path, {name.replace("_", "-"): value for name, value in (key | headers).items()}
    )


def ask_upgrade(server, path, headers):
    host = server.url.split("/")[2]
    text = f"GET {path} HTTP/1.1\r\n" + "".join(
        f"{n}: {v}\r\n" for n, v in ({"Host": host} | headers).items()
    )
    name, _, port = host.partition(":")
    with socket.create_connection((name, int(port)), timeout=5) as wire:
        wire.sendall((text + "\r\n").encode())
        return int(wire.recv(100).split()[1])


def test_refuses_before_the_token(server):
    token = server.address.partition("=")[2]
    wrong = token[:-1] + ("A" if token[-1] != "A" else "B")
    for path in (
        "/",
        f"/?token={wrong}",
        "/?token=",
        "/files/numbers",
        f"/files/numbers?token={token}",
        "/x",
    ):
        status, headers, body = ask(server, path)
        assert (status, "private" in body) == (403, True), path
        assert "set-cookie" not in headers
    assert ask(server, f"/?token={token}", method="HEAD")[0] == 403  # a preview does not spend the token
    assert ask(server, f"/?token={token}", Host="evil.example:80")[0] == 403
    assert ask(server, "/_nicegui_ws/socket.io/?EIO=4&transport=polling")[0] == 403
    assert upgrade(server, Origin=server.url.rstrip("/")) == 403


@pytest.fixture(scope="module")
def cookie(server, browser):  # noqa: F811
    """The page was opened, used and left; the cookie that the browser got."""
    with tab(browser) as opened:
        page = opened.page
        page.goto(server.address)
        page.get_by_role("button", name="Add").click()
        page.get_by_text("1", exact=True).wait_for()
        assert page.url == server.url  # the token is gone from the address
        assert page.title() == "Work"
        page.get_by_role("button", name="Wrong").click()
        page.locator(".local-page-error", has_text="The file is missing.").wait_for()
        (cookie,) = page.context.cookies()
        assert (cookie["httpOnly"], cookie["sameSite"], cookie["domain"]) == (True, "Strict", "127.0.0.1")
        blocked = page.evaluate("fetch('https://example.com').then(() => 'sent', () => 'blocked')")
        assert blocked == "blocked"  # by the page's own policy, whatever the network is
        assert (opened.elsewhere, opened.complaints) == ([], [])
        assert len(opened.asked) > 5
    return f"{cookie['name']}={cookie['value']}"


def test_the_token_works_once(server, cookie):
    token = server.address.partition("?")[2]
    status, headers, body = ask(server, f"/?{token}")
    assert status == 403
    assert "opened already" in body
    assert "set-cookie" not in headers
    assert ask(server, f"/?{token}", Cookie=cookie)[0] == 200  # the browser that has the page may come back


def test_the_cookie_opens_pages_and_sockets_of_this_page_only(server, cookie):
    own = server.url.rstrip("/")
    status, headers, body = ask(server, "/files/numbers", Cookie=cookie)
    assert (status, body) == (200, "12345")
    assert headers["cache-control"] == "no-store"
    assert "default-src 'self'" in headers["content-security-policy"]
    assert ask(server, "/", Cookie=cookie)[1]["cache-control"] == "no-store"
    assert ask(server, "/files/others", Cookie=cookie)[0] == 404
    assert ask(server, "/", Cookie=cookie, Host="evil.example")[0] == 403  # DNS rebinding
    assert ask(server, "/", Cookie=cookie, Origin="http://evil.example")[0] == 403
    assert ask(server, "/", Cookie=cookie[:-1] + "!")[0] == 403
    assert upgrade(server, Cookie=cookie, Origin=own) == 101
    assert upgrade(server, Cookie=cookie, Origin="http://evil.example") == 403
    assert upgrade(server, Cookie=cookie) == 403  # browsers always send an origin
    assert upgrade(server, Origin=own) == 403
    assert upgrade(server, Cookie=cookie, Origin=own, Host="evil.example") == 403


def test_it_listens_on_this_computer_only(server):
    port = int(server.url.split(":")[2].rstrip("/"))
    others = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    for address in others - {"127.0.0.1"}:
        with pytest.raises(OSError):
            socket.create_connection((address, port), timeout=0.5).close()


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_ends_it_quietly(name):
    """Ctrl-C, a process that is asked to end, a terminal that is closed: what is to be tidied is."""
    with served("-c", PAGE) as running:
        running.process.send_signal(getattr(signal, name))
        text, _ = running.process.communicate(timeout=10)
        assert running.process.returncode == 0
        assert "Traceback" not in text
        assert text.split()[-1] == "interrupted"


def test_done_ends_it_with_a_farewell(browser):  # noqa: F811
    with served("-c", PAGE) as running, tab(browser) as opened:
        opened.page.goto(running.address)
        opened.page.get_by_role("button", name="Done").click()
        opened.page.locator("#farewell", has_text="Saved to out").wait_for()
        assert running.process.wait(10) == 0
        assert running.process.stdout.read().split()[-2:] == ["tidied", "done"]
        assert opened.complaints == []


def test_it_ends_with_the_browser_if_asked(browser):  # noqa: F811
    page = PAGE.replace("open_browser=False", "open_browser=False, close_with_browser=True").replace(
        "from nicegui import ui",
        "from nicegui import ui\nimport acino_fte.local_page as it\nit._AWAY = 0.2",
        1,
    )
    with served("-c", page) as running:
        with tab(browser) as opened:
            opened.page.goto(running.address)
            opened.page.get_by_text("0", exact=True).wait_for()
            time.sleep(0.4)
            assert running.process.poll() is None
        assert running.process.wait(10) == 0
        assert running.process.stdout.read().split()[-2:] == ["browser", "closed"]


def test_a_port_in_use_is_said():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(InputError, match="cannot be served at this port"):
            serve_page(lambda session: None, title="x", port=taken.getsockname()[1], open_browser=False)
