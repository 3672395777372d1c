"""Who may ask what: hosts, origins, the token, methods, sizes. A page elsewhere in the browser, or a name that somebody
points at this machine, is refused before anything is looked up.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import secrets
import socket
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any
from urllib.parse import parse_qs, urlsplit

from starlette.requests import ClientDisconnect
from starlette.responses import PlainTextResponse, Response

from torchpose.errors import printable

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

_REFUSAL = "torchpose.refused"  # entry of a scope
COOKIE = "torchpose_live"
_LONGEST_SHOWN = 80  # characters of a path in the line about a refusal
MOST_HEAD = 16384  # bytes of headers (convention): those of browsers have one or two thousand
_LONGEST_TARGET = 1024  # characters of path and query
_MOST_BODY = 1024  # bytes: requests have a word or two
_MOST_COOKIES = 4  # of one name, that are looked at
HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
    "cache-control": "no-store",
}
_RAW_HEADERS = [(name.encode(), value.encode()) for name, value in HEADERS.items()]


class Refused(Exception):
    """A request that is not answered: status and the reason in a few words, for the log and for whoever asked."""

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status, self.reason = status, reason


def refusal(scope: Scope, refused: Refused) -> Response:
    """The answer of an application behind the guard, which tells of it."""
    scope[_REFUSAL] = refused
    headers = {"connection": "close"} | ({"retry-after": "5"} if refused.status == 503 else {})
    return PlainTextResponse(f"{refused.reason}\n", refused.status, headers)


class Guard:
    """Lets through what may be asked.

    Args:
        app: behind it.
        host: that is listened on.
        token: that is demanded; None: none.
        tell: is given a line for each refusal.
    """

    def __init__(self, app: App, host: str, token: str | None, tell: Callable[[str], None]) -> None:
        self._app, self._tell = app, tell
        self._token = None if token is None else _digest(token)
        self._cookie = secrets.token_urlsafe(32)  # of this run; the token itself stays out of the browser's store
        self._hosts = _own_names(host)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return await self._app(scope, receive, send)

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), *_RAW_HEADERS]
            await send(message)

        try:
            headers = _headers(scope)
            self._check(scope, headers)
            if self._enters(scope):
                return await self._let_in(scope, guarded)
            await self._app(scope, _bounded(receive), guarded)
            if _REFUSAL in scope:
                self._log(scope, scope[_REFUSAL])
        except ClientDisconnect:
            pass  # before its body was whole; a connection that was dropped has been told of
        except Refused as refused:
            self._log(scope, refused)
            await _answer(guarded, refused.status, refused.reason)

    def _check(self, scope: Scope, headers: dict[str, list[str]]) -> None:
        """Raises Refused."""
        for name in ("host", "origin", "authorization", "content-length", "content-type"):
            if len(headers.get(name, [])) > 1:
                raise Refused(400, f"{name} given twice")
        if sum(len(name) + len(value) for name, value in scope["headers"]) > MOST_HEAD:
            raise Refused(431, "headers too long")
        if len(scope["path"]) + len(scope["query_string"]) > _LONGEST_TARGET:
            raise Refused(414, "address too long")
        if scope["method"] not in ("GET", "HEAD", "POST"):
            raise Refused(405, "method not allowed")
        host = headers.get("host", [""])[0]
        if not self._is_own(host):
            raise Refused(421, f"host {host!r} is not this one")
        for origin in headers.get("origin", []):
            if origin.lower() != f"http://{host.lower()}":
                raise Refused(403, f"foreign origin {origin!r}")
        self._check_site(scope, headers)
        self._check_body(scope, headers)
        if self._token is not None and not self._enters(scope) and not self._is_known(headers):
            raise Refused(401, "token missing or wrong; open /?token=TOKEN once")

    def _check_site(self, scope: Scope, headers: dict[str, list[str]]) -> None:
        """What a browser says of who asks: a page elsewhere may link here, and nothing else."""
        site = headers.get("sec-fetch-site", ["none"])[0]
        linked = scope["path"] == "/" and headers.get("sec-fetch-mode", [""])[0] == "navigate"
        if site not in ("same-origin", "none") and not (linked and scope["method"] == "GET"):
            raise Refused(403, f"asked from another site ({site})")

    def _check_body(self, scope: Scope, headers: dict[str, list[str]]) -> None:
        length = headers.get("content-length", ["0"])[0]
        if not (length.isascii() and length.isdigit()) or int(length) > _MOST_BODY:
            raise Refused(413, f"body of {length} bytes")
        if "transfer-encoding" in headers and "content-length" in headers:
            raise Refused(400, "a body of two lengths")
        if scope["method"] == "POST":
            kind = headers.get("content-type", [""])[0].partition(";")[0].strip().lower()
            if kind != "application/json":
                raise Refused(415, "body is not application/json")
        elif int(length) or "transfer-encoding" in headers:
            raise Refused(400, "a body where none belongs")

    def _is_own(self, host: str) -> bool:
        """Whether a Host header names this machine: an address, or a name that is known. Others may be pointed here."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
            _ = urlsplit(f"//{host}").port
        except ValueError:
            return False
        if any(character in host for character in "/\\@?# \t"):
            return False
        return name in self._hosts or (_is_address(name) and "*" in self._hosts)

    def _is_known(self, headers: dict[str, list[str]]) -> bool:
        """Whether the token, or the cookie that was given for it, is there."""
        given = headers.get("authorization", [""])[0]
        if given[:7].lower() == "bearer " and self._is_token(given[7:].strip()):
            return True
        own = _digest(self._cookie)
        return any(hmac.compare_digest(_digest(value), own) for value in _cookies(headers))

    def _is_token(self, given: str) -> bool:
        return self._token is not None and hmac.compare_digest(_digest(given), self._token)

    def _enters(self, scope: Scope) -> bool:
        """Whether a request is the one that brings the right token in its URL."""
        if self._token is None or scope["path"] != "/" or scope["method"] != "GET":
            return False
        try:
            given = parse_qs(scope["query_string"].decode("ascii"), max_num_fields=4).get("token", [])
        except ValueError:
            return False
        return len(given) == 1 and self._is_token(given[0])

    async def _let_in(self, scope: Scope, send: Send) -> None:
        """Gives the cookie and leads to the page without the token in its URL."""
        cookie = f"{COOKIE}={self._cookie}; HttpOnly; SameSite=Strict; Path=/"
        await _answer(send, 303, "", [(b"location", b"/"), (b"set-cookie", cookie.encode())])

    def _log(self, scope: Scope, refused: Refused) -> None:
        client = (scope.get("client") or ["unknown"])[0]
        path = scope["path"]
        shown = path if len(path) <= _LONGEST_SHOWN else f"{path[:_LONGEST_SHOWN]}..."
        reason = (
            refused.reason if len(refused.reason) <= 2 * _LONGEST_SHOWN else f"{refused.reason[:_LONGEST_SHOWN]}..."
        )
        self._tell(printable(f"refused {refused.status} {client} {scope['method']} {shown}: {reason}"))


def _own_names(host: str) -> set[str]:
    """Names by which this machine is asked; ``*`` stands for any address, where it listens beyond loopback."""
    names = {"localhost", "127.0.0.1", "::1", host.lower()}
    if is_loopback(host):
        return names
    own = {socket.gethostname().lower(), socket.getfqdn().lower()}
    return names | own | {f"{name}.local" for name in own} | {"*"}


def is_loopback(host: str) -> bool:
    """Whether only this machine can ask there."""
    if host.lower() == "localhost":
        return True
    return _is_address(host) and ipaddress.ip_address(host).is_loopback


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _digest(text: str) -> bytes:
    """Of equal length for all texts, so that comparing tells nothing of the length either."""
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).digest()


def _headers(scope: Scope) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for name, value in scope["headers"]:
        found.setdefault(name.decode("latin-1").lower(), []).append(value.decode("latin-1"))
    return found


def _cookies(headers: dict[str, list[str]]) -> list[str]:
    """Values of the page's cookie: what listens at another port of this host may have set one of that name, too.

    Read by hand: 15 kB of backslashes are half a second's work for `http.cookies` of Python 3.11.2 (CVE-2024-7592).
    """
    pairs = (part.strip().partition("=") for part in "; ".join(headers.get("cookie", [])).split(";"))
    return [value for name, _, value in pairs if name == COOKIE][:_MOST_COOKIES]


def _bounded(receive: Receive) -> Receive:
    """The same, refusing bodies that grow beyond what requests have."""
    size = 0

    async def counted() -> Message:
        nonlocal size
        message = await receive()
        size += len(message.get("body", b""))
        if size > _MOST_BODY:
            raise Refused(413, "body too long")
        return message

    return counted


async def _answer(send: Send, status: int, text: str, headers: list[tuple[bytes, bytes]] | None = None) -> None:
    body = f"{text}\n".encode() if text else b""
    about = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(body)).encode())]
    if status >= 400:
        about.append((b"connection", b"close"))
    if status == 401:
        about.append((b"www-authenticate", b"Bearer"))
    await send({"type": "http.response.start", "status": status, "headers": [*about, *(headers or [])]})
    await send({"type": "http.response.body", "body": body})
