"""Attacks on the page: each is refused and logged in one line, and the estimator goes on."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.live.cell import Page, Scene, picture, served
from torchpose.live import server
from torchpose.live.app import MOST_VIEWERS
from torchpose.live.guard import COOKIE, Guard, _cookies, is_loopback

TOKEN = "a token of some length"


class Client:
    """A page and someone who asks it."""

    def __init__(self, page: Page) -> None:
        self.http = httpx.Client(base_url=page.url, follow_redirects=False, timeout=30)
        self.page, self.lines = page, page.lines

    def told(self, before: int) -> str:
        """The one line that has come since there were so many."""
        self.page.until(lambda: len(self.lines) > before)
        assert len(self.lines) == before + 1
        return self.lines[-1]


@contextlib.contextmanager
def client(folder: Path, token: str | None = None) -> Iterator[Client]:
    with served(Scene(gap_s=0.5), folder, token=token) as page:
        page.until(lambda: page.live.snapshot.sight is not None, 60)
        found = Client(page)
        with found.http:
            yield found


@pytest.fixture(scope="module")
def open_page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    with client(tmp_path_factory.mktemp("open")) as found:
        yield found


@pytest.fixture(scope="module")
def closed_page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    with client(tmp_path_factory.mktemp("closed"), TOKEN) as found:
        yield found


TRAVERSALS = [
    "/../../etc/passwd",
    "/..%2f..%2fetc/passwd",
    "/live.css/../../guard.py",
    "/%2e%2e/%2e%2e/etc/passwd",
    "//etc/passwd",
    "/api/../../secret",
    "/live.js%00.png",
    "/page/",
    "/static/",
    "/api",
    "/api/",
    "/api/state/",
    "/.git/config",
    "/api/still/..%5c..%5cx",
]


@pytest.mark.parametrize("path", TRAVERSALS)
def test_paths_lead_nowhere(open_page: Client, path: str) -> None:
    before = len(open_page.lines)
    request = open_page.http.build_request("GET", "/")
    request.url = request.url.copy_with(raw_path=path.encode())
    answer = open_page.http.send(request)
    assert answer.status_code == 404
    assert "root" not in answer.text
    assert "refused 404" in open_page.told(before)


FOREIGN: list[tuple[dict[str, str], int]] = [
    ({"origin": "http://evil.example"}, 403),
    ({"origin": "null"}, 403),
    ({"origin": "https://127.0.0.1:8765"}, 403),
    ({"origin": "http://127.0.0.1:8766"}, 403),
    ({"host": "evil.example"}, 421),
    ({"host": "evil.example:8765", "origin": "http://evil.example:8765"}, 421),  # rebinding: both agree
    ({"host": "127.0.0.1.evil.example"}, 421),
    ({"host": "127.0.0.1@evil.example"}, 421),
    ({"host": "192.0.2.7:8765"}, 421),  # not where it listens
    ({"host": "0.0.0.0:8765"}, 421),  # what some browsers let a page ask as this machine
    ({"host": "2130706433"}, 421),  # 127.0.0.1 as one number, as a resolver may read it
    ({"host": "127.1:8765"}, 421),
    ({"host": "[::ffff:127.0.0.1]:8765"}, 421),
    ({"host": "localhost.evil.example"}, 421),
    ({"host": "localhost:8765, evil.example"}, 421),
    ({"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"}, 403),
    ({"sec-fetch-site": "same-site"}, 403),
    ({"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}, 403),  # to anything but the page itself
]


@pytest.mark.parametrize(("headers", "status"), FOREIGN, ids=lambda value: str(value)[:50])
@pytest.mark.parametrize("path", ["/api/state", "/api/picture", "/api/events", "/api/still"])
def test_others_are_refused(open_page: Client, headers: dict[str, str], status: int, path: str) -> None:
    before = len(open_page.lines)
    kind = {"content-type": "application/json"}
    answer = (
        open_page.http.post(path, content="{}", headers=headers | kind)
        if path == "/api/still"
        else open_page.http.get(path, headers=headers)
    )
    assert answer.status_code == status
    line = open_page.told(before)
    assert f"refused {status}" in line
    assert "\n" not in line


def test_own_names_are_let_in(open_page: Client) -> None:
    for host in ("127.0.0.1:8765", "localhost:8765", "localhost:9000", "[::1]:8765"):
        answer = open_page.http.get("/api/state", headers={"host": host, "origin": f"http://{host}"})
        assert answer.status_code == 200, host
    linked = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
    assert open_page.http.get("/", headers=linked).status_code == 200  # a link in a mail


def test_every_answer_has_its_headers(open_page: Client) -> None:
    for path in ("/", "/live.js", "/api/state", "/nowhere"):
        headers = open_page.http.get(path).headers
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert "http" not in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["x-frame-options"] == "DENY"
        assert headers["cache-control"] == "no-store"
        assert "server" not in headers


def test_the_page_asks_nobody_else() -> None:
    folder = Path(server.__file__).parent / "page"
    for path in folder.iterdir():
        text = path.read_text().replace("http://www.w3.org/2000/svg", "")
        assert "http:" not in text, path
        assert "https:" not in text, path
        assert "//" not in text.replace("// ", ""), path
        assert "style=" not in text, path  # the policy has no place for it
        assert "onclick" not in text, path
        assert "innerHTML" not in text, path  # a frame may be called anything: names are shown as text
        assert "insertAdjacentHTML" not in text, path


MALFORMED: list[tuple[str, bytes, str, int]] = [
    ("/api/recording", b"", "application/json", 400),
    ("/api/recording", b"{", "application/json", 400),
    ("/api/recording", b"[]", "application/json", 400),
    ("/api/recording", b'{"on": 1}', "application/json", 400),
    ("/api/recording", b'{"on": true, "name": "../x"}', "application/json", 400),
    ("/api/recording", b'{"on": true, "on": false, "folder": "/"}', "application/json", 400),
    ("/api/recording", b"\xff\xfe", "application/json", 400),
    ("/api/recording", b"[" * 900, "application/json", 400),
    ("/api/recording", b'{"on": true}', "text/plain", 415),  # what a form of another page can send
    ("/api/recording", b'{"on": true}', "application/x-www-form-urlencoded", 415),
    ("/api/still", b'{"name": "../../x.png"}', "application/json", 400),
    ("/api/still", b" " * 2000 + b"{}", "application/json", 413),
    ("/api/move", b'{"to": [0, 0, 0]}', "application/json", 404),
    ("/api/state", b"{}", "application/json", 405),
]


@pytest.mark.parametrize(("path", "body", "kind", "status"), MALFORMED, ids=lambda value: str(value)[:30])
def test_malformed_messages_are_refused(open_page: Client, path: str, body: bytes, kind: str, status: int) -> None:
    before = len(open_page.lines)
    answer = open_page.http.post(path, content=body, headers={"content-type": kind})
    assert answer.status_code == status
    open_page.told(before)
    assert not open_page.http.get("/api/about").text.count("recording-")


def test_methods_and_doubled_headers(open_page: Client) -> None:
    for method in ("PUT", "DELETE", "OPTIONS", "TRACE", "PATCH"):
        assert open_page.http.request(method, "/api/state").status_code == 405
    twice = [("host", "127.0.0.1:8765"), ("origin", "http://127.0.0.1:8765"), ("origin", "http://evil.example")]
    assert open_page.http.get("/api/state", headers=twice).status_code == 400
    assert open_page.http.request("GET", "/api/state", content=b"x").status_code == 400
    assert open_page.http.get("/api/recording").status_code == 405
    assert open_page.http.head("/api/events").status_code == 405  # would be a viewer who is told nothing
    assert open_page.http.head("/api/state").status_code == 200


def test_no_token_no_answer(closed_page: Client) -> None:
    known = closed_page.http
    known.cookies.clear()
    for path in ("/", "/live.js", "/api/state", "/api/events", "/api/picture", "/nowhere", "/api/about"):
        for headers in (
            {},
            {"authorization": "Bearer wrong"},
            {"authorization": TOKEN},
            {"authorization": "Basic d3Jvbmc="},
            {"cookie": "torchpose_live=wrong"},
            {"cookie": f"torchpose_live={TOKEN}"},
            {"cookie": "torchpose_live="},
            {"cookie": 'a=;;;=;"torchpose_live'},
            {"cookie": "torchpose_live=a;" * 800},
        ):
            before = len(closed_page.lines)
            answer = known.get(path, headers=headers)
            assert answer.status_code == 401, (path, headers)
            assert TOKEN not in closed_page.told(before)
    for path in ("/?token=wrong", "/?token=", f"/?token={TOKEN}&token=x", f"/api/state?token={TOKEN}"):
        assert known.get(path).status_code == 401, path


def test_token_as_header_or_once_in_the_url(closed_page: Client) -> None:
    known = closed_page.http
    known.cookies.clear()
    assert known.get("/api/state", headers={"authorization": f"Bearer {TOKEN}"}).status_code == 200
    first = known.get("/", params={"token": TOKEN})
    assert first.status_code == 303
    assert first.headers["location"] == "/"  # the token is out of the address bar
    given = first.headers["set-cookie"]
    assert "HttpOnly" in given
    assert "SameSite=Strict" in given
    assert TOKEN not in given
    assert known.get("/").status_code == 200
    assert known.get("/api/state").status_code == 200
    foreign = known.get("/api/state", headers={"origin": "http://evil.example"})
    assert foreign.status_code == 403  # the cookie alone lets nobody in


def test_beyond_loopback_addresses_are_names_and_others_are_not() -> None:
    async def app(scope: Any, receive: Any, send: Any) -> None: ...

    guard = Guard(app, "0.0.0.0", TOKEN, lambda line: None)
    for host in ("192.168.1.20:8765", "[fe80::1]:8765", "localhost", socket.gethostname()):
        assert guard._is_own(host), host
    for host in ("evil.example", "192.168.1.20.evil.example", "a@192.168.1.20", "192.168.1.20:x", "[::1", ""):
        assert not guard._is_own(host), host
    assert is_loopback("127.0.0.9")
    assert is_loopback("::1")
    assert not is_loopback("0.0.0.0")
    assert not is_loopback("127.0.0.1.evil.example")


def test_no_path_of_the_machine_is_told(open_page: Client, tmp_path: Path) -> None:
    state = open_page.http.get("/api/state")
    assert state.json()["frame"].endswith(".png")
    for path in ("/", "/api/about", "/api/state", "/nowhere"):
        text = open_page.http.get(path).text
        assert "/tmp" not in text
        assert str(Path.cwd()) not in text
        assert str(Path.home()) not in text or str(Path.home()) == "/"


# ---- over a socket


def raw(page: Page, request: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", page.port), timeout=10) as connection:
        connection.sendall(request)
        connection.shutdown(socket.SHUT_WR)
        answer = b""
        while part := connection.recv(65536):
            answer += part
        return answer


def test_what_is_no_http_is_refused(tmp_path: Path) -> None:
    with served(Scene(), tmp_path) as page:
        for request in (
            b"\x16\x03\x01\x02\x00" + bytes(200),
            b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n" + b"X: a\r\n" * 12_000 + b"\r\n",
            b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: a\0b\r\n\r\n",
            b"GET / HTTP/1.1\r\nHost : 127.0.0.1\r\n\r\n",
            b"GET / HTTP/1.0\r\n\r\n",
            b"POST /api/still HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: " + b"9" * 5000 + b"\r\n\r\n",
            CHUNKED + b"Content-Length: 2\r\n\r\n2\r\n{}\r\n0\r\n\r\n",  # two lengths: who splits them is fooled
            CHUNKED + b"\r\nfffffffffffffffffffffff\r\n{}",
            CHUNKED + b"\r\n" + b"100\r\n" + bytes(256) + b"\r\n" + b"400\r\n" + bytes(1024) + b"\r\n0\r\n\r\n",
            CHUNKED + b"\r\n2;" + b"x" * 70_000,  # an extension without end
            b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"a" * 70_000 + b"\r\n\r\n",
            b"GET / HTTP/1.1\r\n\r\n",
            b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
            b"POST /api/still HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: -5\r\n\r\n",
            b"GET / NONSENSE\r\n\r\n",
        ):
            before = len(page.lines)
            assert raw(page, request).split(b" ")[1] in (b"400", b"413", b"421", b"431"), request[100:180]
            page.until(lambda before=before: len(page.lines) == before + 1)  # type: ignore[misc]
        absolute = b"GET http://evil.example/api/state HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n"
        assert b" 404 " in raw(page, absolute)
        upgrade = b"GET /api/state HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\r\n"
        assert b" 101 " not in raw(page, upgrade)
        assert httpx.get(f"{page.url}/api/about").status_code == 200


CHUNKED = (
    b"POST /api/still HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\nTransfer-Encoding: chunked\r\n"
)


def test_a_flood_of_websockets_gets_none_and_the_estimator_goes_on(tmp_path: Path) -> None:
    upgrade = (
        b"GET /api/events HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
        b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    )
    with served(Scene(), tmp_path) as page, contextlib.ExitStack() as stack:
        page.until(lambda: page.live.snapshot.sight is not None, 30)
        before, answers = page.live.snapshot.number, []
        for _ in range(60):
            connection = stack.enter_context(socket.create_connection(("127.0.0.1", page.port), timeout=10))
            with contextlib.suppress(ConnectionError):
                connection.sendall(upgrade + b"\x81\xff" * 8000)  # frames that nobody reads
            answers.append(connection)
        for connection in answers:
            with contextlib.suppress(ConnectionError):
                assert b" 101 " not in connection.recv(200)
        assert httpx.get(f"{page.url}/api/state", timeout=10).json()["status"] == "ok"
        page.until(lambda: page.live.snapshot.number > before + 2, 20)


def test_a_flood_of_refusals_fills_no_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "_MINUTE", 3600.0)  # so that a busy machine does not begin a second one
    many = server.MOST_LINES + 60
    with served(Scene(), tmp_path, token=TOKEN) as page:
        page.until(lambda: page.live.snapshot.sight is not None, 30)
        before = page.live.snapshot.number
        with httpx.Client(base_url=page.url, timeout=30) as http:
            found = {http.get("/", params={"token": f"guess {number}"}).status_code for number in range(many)}
            assert found == {401}
            known = {"authorization": f"Bearer {TOKEN}"}
            assert http.get("/api/state", headers=known).json()["status"] == "ok"
        assert len(page.lines) == server.MOST_LINES
        page.until(lambda: page.live.snapshot.number > before + 2, 20)
    assert page.lines[-1] == "60 more such lines were left out"


def test_lines_come_again_when_a_minute_has_passed() -> None:
    lines: list[str] = []
    now = [0.0]
    tell = server.Bounded(lines.append, lambda: now[0])
    for number in range(server.MOST_LINES + 5):
        tell(str(number))
    now[0] = 60.0
    tell("next")
    assert lines[-3:] == [str(server.MOST_LINES - 1), "5 more such lines were left out", "next"]


def test_a_cookie_costs_no_time() -> None:
    """A quote full of backslashes is half a second's work for `http.cookies` of Python 3.11.2 (CVE-2024-7592)."""
    headers = {"cookie": [f'{COOKIE}="' + "\\" * 15_000 + '"']}
    began = time.process_time()
    assert _cookies(headers) == [headers["cookie"][0].partition("=")[2]]
    assert time.process_time() - began < 0.02


def test_slow_clients_are_dropped_and_the_estimator_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "SILENT_S", 1.0)
    monkeypatch.setattr(server, "STALLED_S", 1.0)
    with served(Scene(), tmp_path) as page:
        page.until(lambda: page.live.snapshot.sight is not None, 30)
        with httpx.stream("GET", f"{page.url}/api/events", timeout=20) as viewer, contextlib.ExitStack() as stack:
            heard = iter(viewer.iter_lines())
            assert next(heard) == "event: history"
            slow = []
            for number in range(100):
                connection = stack.enter_context(socket.create_connection(("127.0.0.1", page.port), timeout=10))
                # some say nothing, some only begin, some announce a body that never comes
                connection.sendall((b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: ", BODY)[number % 4])
                slow.append(connection)
            began = page.live.snapshot.number
            for connection in slow:
                connection.settimeout(10)
                with contextlib.suppress(ConnectionError):
                    while connection.recv(4096):
                        pass
            page.until(lambda: len(page.lines) >= 100)
            assert len(page.lines) == 100
            assert all(line.startswith("dropped 127.0.0.1: ") for line in page.lines)
            page.until(lambda: page.live.snapshot.number > began + 2, 20)
            assert any(line == "event: frame" for line in (next(heard) for _ in range(50)))
        assert httpx.get(f"{page.url}/api/state").json()["status"] == "ok"


BODY = b"POST /api/still HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\nContent-Length: 9\r\n\r\n{"


def test_a_viewer_who_takes_nothing_is_dropped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "STALLED_S", 1.0)
    with served(Scene(gap_s=0.01), tmp_path) as page:
        page.until(lambda: page.live.snapshot.sight is not None, 30)
        with socket.socket() as connection:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            connection.connect(("127.0.0.1", page.port))
            ask = b"GET /api/picture HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
            connection.sendall(ask * 200)  # pipelined, megabytes of answers, none of which is taken
            page.until(lambda: any("takes nothing" in line for line in page.lines), 20)
        before = page.live.snapshot.number
        page.until(lambda: page.live.snapshot.number > before + 1)


def test_viewers_have_a_limit(tmp_path: Path) -> None:
    with served(Scene(gap_s=0.2), tmp_path) as page, contextlib.ExitStack() as stack:
        page.until(lambda: page.live.snapshot.sight is not None, 30)
        limits = httpx.Limits(max_connections=MOST_VIEWERS + 8)
        http = stack.enter_context(httpx.Client(base_url=page.url, limits=limits, timeout=20))
        heard = []
        for _ in range(MOST_VIEWERS):
            answer = stack.enter_context(http.stream("GET", "/api/events"))
            assert answer.status_code == 200
            heard.append(answer.iter_lines())
            assert next(heard[-1]) == "event: history"
        with http.stream("GET", "/api/events") as refused:
            assert refused.status_code == 503
        page.until(lambda: any("refused 503" in line for line in page.lines))


def test_connections_without_a_request_make_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "MOST_CONNECTIONS", 8)
    with served(Scene(), tmp_path) as page, contextlib.ExitStack() as stack:
        for _ in range(20):
            stack.enter_context(socket.create_connection(("127.0.0.1", page.port)))
        assert httpx.get(f"{page.url}/api/about", timeout=5).status_code == 200
        assert len([line for line in page.lines if "more than 8 connections" in line]) >= 12


def test_requests_at_once_share_one_picture(tmp_path: Path) -> None:
    scene = Scene(images=[picture(number) for number in range(3)], gap_s=0.3)
    with served(scene, tmp_path) as page:
        page.until(lambda: page.live.snapshot.sight is not None, 30)
        found: list[tuple[str, bytes]] = []

        def ask() -> None:
            answer = httpx.get(f"{page.url}/api/picture", timeout=20)
            found.append((answer.headers["x-version"], answer.content))

        threads = [threading.Thread(target=ask) for _ in range(10)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(found) == 10
        by_version = dict(found)
        assert all(by_version[version] == content for version, content in found)
        assert len(by_version) <= 3
