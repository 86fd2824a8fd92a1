"""Server of the report page on this machine, which sends frames on request.

Only names of a fixed pattern in two folders are opened, so that no request reaches another file. Requests
under another host name are refused, against DNS rebinding by other pages.
"""

import ipaddress
import re
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from glintrack.io.untrusted import resolve_path
from glintrack.report.page import build_page
from glintrack.results.read import Result

_FILE = re.compile(r"/(film/[a-z]+_[0-9]{5}\.webp|pictures/[a-z_]+\.png)", re.ASCII)
_TYPES = {"webp": "image/webp", "png": "image/png"}


class ResultServer(ThreadingHTTPServer):
    """Server of one result; ``serve_forever`` runs it.

    Parameters
    ----------
    result, page
        The folder, and its page with pictures by name.
    address
        Host and port; port 0 takes a free one.
    """

    daemon_threads = True

    def __init__(self, result: Result, page: str, address: tuple[str, int]):
        self.result, self.page = result, page.encode()
        super().__init__(address, _Handler)

    def handle_error(self, request, client_address) -> None:
        """Ignore a lost connection."""

    @property
    def on_loopback(self) -> bool:
        """Return True if only this machine can reach it."""
        return ipaddress.ip_address(str(self.server_address[0])).is_loopback


def serve_result(
    result: Result, host: str = "127.0.0.1", port: int = 0, base: str | None = None
) -> ResultServer:
    """Server of a result's page, listening but not yet running.

    Parameters
    ----------
    result
        From `read_result`.
    host, port
        Address; loopback by default, port 0 for a free one.
    base
        See `build_page`.

    Raises
    ------
    ValueError
        If the address cannot be listened on.
    """
    page = build_page(result, base, inline=False)
    try:
        return ResultServer(result, page, (host, port))
    except (OSError, OverflowError) as error:
        raise ValueError(
            f"`host` and `port` must be free to listen on, got {host}:{port} ({error})"
        ) from error


class _Handler(BaseHTTPRequestHandler):
    server: ResultServer
    server_version = "glintrack"
    sys_version = ""
    timeout = 30.0  # without anything read or taken [s]

    def do_GET(self) -> None:
        """Send the page, a picture or 404."""
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        """Send the header only."""
        self._answer(with_body=False)

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: a film is a thousand requests."""

    def _answer(self, with_body: bool) -> None:
        if self.server.on_loopback and not self._names_this_machine():
            self._send(HTTPStatus.FORBIDDEN, "text/plain", b"another host name\n", with_body)
        elif self.path in ("/", "/index.html"):
            self._send(HTTPStatus.OK, "text/html; charset=utf-8", self.server.page, with_body)
        else:
            body = self._picture()
            if body is None:
                self._send(HTTPStatus.NOT_FOUND, "text/plain", b"not found\n", with_body)
            else:
                self._send(HTTPStatus.OK, _TYPES[self.path.rpartition(".")[2]], body, with_body)

    def _names_this_machine(self) -> bool:
        name = self.headers.get("Host", "").rsplit(":", 1)[0].strip("[]")
        try:
            return name == "localhost" or ipaddress.ip_address(name).is_loopback
        except ValueError:
            return False

    def _picture(self) -> bytes | None:
        """Picture of the path, if it is a plain file inside the result; None if not."""
        match = _FILE.fullmatch(self.path)
        if match is None:
            return None
        root = self.server.result.path.resolve()
        path = resolve_path(root / match[1])
        if not (path.is_file() and path.is_relative_to(root)):  # not through a link that leads out
            return None
        return path.read_bytes()

    def _send(self, status: HTTPStatus, kind: str, body: bytes, with_body: bool) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        if with_body:
            self.wfile.write(body)
