"""A server for one page on this machine: it listens on 127.0.0.1, and answers who knows a secret alone.

The secret is part of the address. No file is served by its name: the answers are functions, one for each
request that there is. `Host` and `Origin` are checked, so that no page of another site can ask, even one
whose name leads here.
"""

import contextlib
import secrets
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

Answer = tuple[str, bytes]  # the media type, and the content
Answers = Mapping[tuple[str, str], Callable[[bytes], Answer]]  # by method and name; they get the body
PATIENCE = 60.0  # seconds for a request to arrive
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class Refused(Exception):
    """A request that gets no answer, with the status and a line."""


class Loopback(ThreadingHTTPServer):
    """The server. Answers are given one at a time; a ValueError in one is the line that the page shows."""

    daemon_threads = True

    def __init__(self, answers: Answers, most: int, port: int = 0) -> None:
        """`most`: bytes that a request may carry."""
        super().__init__(("127.0.0.1", port), _Handler)
        self.answers, self.most = answers, most
        self.secret = secrets.token_urlsafe(24)
        self.one_at_a_time = threading.Lock()

    @property
    def host(self) -> str:
        return f"127.0.0.1:{self.server_address[1]}"

    @property
    def url(self) -> str:
        """The address of the page, with the secret."""
        return f"http://{self.host}/{self.secret}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that went away is no news."""
        if not isinstance(sys.exc_info()[1], ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


@contextlib.contextmanager
def serving(answers: Answers, most: int) -> Iterator[Loopback]:
    """A server that answers, in a thread of its own, while open."""
    server = Loopback(answers, most)
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()


def open_browser(server: Loopback) -> None:
    """Open the page in the browser; where there is none, say so."""
    if not webbrowser.open(server.url):
        print("flx: no browser could be opened; open the address yourself", file=sys.stderr)


class _Handler(BaseHTTPRequestHandler):
    server: Loopback
    timeout = PATIENCE
    server_version, sys_version = "flx", ""

    def do_GET(self) -> None:
        self._answer("GET")

    def do_POST(self) -> None:
        self._answer("POST")

    def _answer(self, method: str) -> None:
        try:
            answer = self._permitted(method)
            body = self._body() if method == "POST" else b""
            with self.server.one_at_a_time:
                kind, content = answer(body)
            status = 200
        except Refused as refused:
            (status, line), kind = refused.args, "text/plain; charset=utf-8"
            content = line.encode()
        except (ValueError, OSError) as fault:
            status, kind = 400, "text/plain; charset=utf-8"
            content = " ".join(str(fault).split()).encode("utf-8", "replace")
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def _permitted(self, method: str) -> Callable[[bytes], Answer]:
        """The answer to a request. Raises Refused for one that is not this page's own."""
        if self.headers.get_all("Host") != [self.server.host]:
            raise Refused(403, f"this is {self.server.host} alone")
        _, secret, *name = self.path.split("/", 2)
        if not secrets.compare_digest(secret.encode(), self.server.secret.encode()):
            raise Refused(403, "the address lacks its secret; open the one that flx printed")
        if method == "POST" and self.headers.get("Origin") != f"http://{self.server.host}":
            raise Refused(403, "only the page itself may send")
        answer = self.server.answers.get((method, name[0] if name else "?"))
        if answer is None:
            raise Refused(404, "there is nothing here")
        return answer

    def _body(self) -> bytes:
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdecimal()):
            raise Refused(411, "say how long it is")
        if len(length) > 12 or int(length) > self.server.most:
            raise Refused(413, f"it has {length[:20]} bytes, more than {self.server.most:,}")
        body = self.rfile.read(int(length))
        if len(body) < int(length):
            raise Refused(400, "it broke off")
        return body

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not printed."""
