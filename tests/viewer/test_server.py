"""Laws of the server: it answers its own page alone, and serves no file by its name."""

import http.client
from collections.abc import Iterator

import pytest

from flx.viewer.server import Loopback, serving


def echo(body: bytes) -> tuple[str, bytes]:
    if body == b"wrong":
        raise ValueError("that\nwas wrong; say another")
    return "text/plain", b"got " + body


@pytest.fixture(scope="module")
def server() -> Iterator[Loopback]:
    with serving({("GET", ""): lambda _: ("text/html", b"page"), ("POST", "save"): echo}, most=100) as served:
        yield served


def asked(server: Loopback, method: str, path: str, body: bytes | None = None, **headers: str):
    """The status, the content and the headers of an answer."""
    link = http.client.HTTPConnection(server.host, timeout=10)
    link.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
    answer = link.getresponse()
    return answer.status, answer.read(), answer.headers


def test_the_page_is_served_to_who_knows_the_secret(server):
    path = server.url.removeprefix(f"http://{server.host}")
    status, content, headers = asked(server, "GET", path)
    assert (status, content) == (200, b"page") and server.server_address[0] == "127.0.0.1"
    assert headers["Cache-Control"] == "no-store" and headers["Referrer-Policy"] == "no-referrer"
    for other in ("/", "/x/", path[:-2] + "/", path.upper() + "x/", "//", f"/{'x' * 5000}/"):
        assert asked(server, "GET", other)[:2] == (
            403,
            b"the address lacks its secret; open the one that flx printed",
        )
    assert len(server.secret) >= 32


@pytest.mark.parametrize("host", ["evil.example", "localhost", "127.0.0.1", "127.0.0.1:1", ""])
def test_another_host_is_refused(server, host):
    assert asked(server, "GET", f"/{server.secret}/", Host=host)[0] == 403


@pytest.mark.parametrize("origin", [None, "null", "http://evil.example", "http://127.0.0.1:1"])
def test_only_its_own_page_may_send(server, origin):
    more = {} if origin is None else {"Origin": origin}
    assert asked(server, "POST", f"/{server.secret}/save", b"x", **more)[0] == 403
    assert asked(server, "POST", f"/{server.secret}/save", b"x", Origin=f"http://{server.host}")[:2] == (
        200,
        b"got x",
    )


@pytest.mark.parametrize(
    "name", ["../etc/passwd", "..%2f..%2fetc%2fpasswd", "save", "data", "//etc/passwd", "?"]
)
def test_no_path_leads_to_a_file(server, name):
    assert asked(server, "GET", f"/{server.secret}/{name}")[:2] == (404, b"there is nothing here")


def test_what_is_too_long_is_refused_before_it_is_read(server):
    path, own = f"/{server.secret}/save", {"Origin": f"http://{server.host}"}
    assert asked(server, "POST", path, b"x" * 100, **own)[0] == 200
    assert asked(server, "POST", path, b"x" * 101, **own)[0] == 413
    for length in ("1" * 30, "-1", "²", "ten"):
        assert asked(server, "POST", path, **own, Content_Length=length)[0] in (411, 413)
    assert asked(server, "POST", path, **own, Transfer_Encoding="chunked")[0] == 411
    assert asked(server, "PUT", path, b"x", **own)[0] == 501


def test_a_fault_is_one_line(server):
    status, line, _ = asked(
        server, "POST", f"/{server.secret}/save", b"wrong", Origin=f"http://{server.host}"
    )
    assert (status, line) == (400, b"that was wrong; say another")
