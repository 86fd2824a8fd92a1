"""The server: the page and its pictures, and nothing else of the machine."""

import http.client
import threading

import pytest

from glintrack.report import serve_result
from glintrack.results.read import read_result
from tests.report.made import write_small_result


@pytest.fixture
def server(tmp_path):
    folder = write_small_result(tmp_path / "result")
    (tmp_path / "secret.webp").write_text("secret")
    (folder / "film" / "pan_99999.webp").symlink_to(tmp_path / "secret.webp")
    served = serve_result(read_result(folder))
    thread = threading.Thread(target=served.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    yield served
    served.shutdown()
    served.server_close()
    thread.join()


def ask(server, path, method="GET", host=None):
    """Status and body; the path goes out as it is, dots and all."""
    connection = http.client.HTTPConnection(*server.server_address[:2], timeout=10)
    connection.putrequest(method, path, skip_host=host is not None)
    if host is not None:
        connection.putheader("Host", host)
    connection.endheaders()
    answer = connection.getresponse()
    return answer.status, answer.read()


def test_the_page_asks_for_its_pictures_by_name(server):
    status, body = ask(server, "/")
    assert status == 200 and b'id="pictures">{}</script>' in body and b"img-src &#39;self&#39; data:;" in body
    status, body = ask(server, "/film/pan_00000.webp")
    assert status == 200 and body[8:12] == b"WEBP"
    assert ask(server, "/", "HEAD") == (200, b"")
    assert server.on_loopback


@pytest.mark.parametrize(
    "path",
    [
        "/case.toml",
        "/film/../case.toml",
        "/film/..%2f..%2fsecret.webp",
        "/film/../../secret.webp",
        "//etc/passwd",
        "/film/pan_00000.webp/../../../secret.webp",
        "/film/pan_99999.webp",  # a link that leads out of the result
        "/film/",
        "/film/pan_00000.webp%00.png",
        "/film/film.json",
        "/pictures/none.png",
        "http://127.0.0.1/film/film.json",
    ],
)
def test_nothing_else_is_reached(server, path):
    assert ask(server, path)[0] == 404


def test_another_host_name_is_refused(server):
    assert ask(server, "/", host="evil.example")[0] == 403
    assert ask(server, "/", host="localhost:1")[0] == 200


def test_nothing_is_written(server):
    assert ask(server, "/", "POST")[0] == 501


def test_a_taken_port_is_said(server):
    with pytest.raises(ValueError, match=r"must be free to listen on; got 127.0.0.1"):
        serve_result(server.result, port=server.server_address[1])
