"""The server: the page and its pictures, and nothing else of the machine."""

import contextlib
import http.client
import socket
import threading
import time

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
    with pytest.raises(ValueError, match=r"must be free to listen on, got 127.0.0.1"):
        serve_result(server.result, port=server.server_address[1])


def test_hundreds_of_connections_leave_room_for_one_more(server):
    before = threading.active_count()
    crowd = []
    try:
        for _ in range(500):
            crowd.append(socket.create_connection(server.server_address[:2], timeout=10))
            crowd[-1].sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX: ")  # and no more
        assert ask(server, "/")[0] == 200
        deadline = time.monotonic() + 10
        while threading.active_count() - before > server.most_connections and time.monotonic() < deadline:
            time.sleep(0.05)  # threads of ended connections go by and by
        assert threading.active_count() - before <= server.most_connections
    finally:
        for one in crowd:
            one.close()


def test_a_request_sent_byte_by_byte_is_ended(server):
    server.longest_s = 0.5
    began = time.monotonic()
    with socket.create_connection(server.server_address[:2], timeout=10) as slow:
        slow.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n")
        with contextlib.suppress(OSError):  # a broken pipe or a reset, as the system has it
            while time.monotonic() - began < 10:
                slow.sendall(b"X")
                time.sleep(0.05)
    assert time.monotonic() - began < 5


def test_an_answer_that_nobody_takes_is_ended(server):
    server.longest_s, server.page = 0.5, bytes(50_000_000)
    began = time.monotonic()
    with socket.create_connection(server.server_address[:2], timeout=10) as deaf:
        deaf.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        while server._since and time.monotonic() - began < 10:
            time.sleep(0.05)
    assert time.monotonic() - began < 5
