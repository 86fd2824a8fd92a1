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
_TYPES = {".webp": "image/webp", ".png": "image/png"}


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
            f"`host` and `port` must be free to listen on; got {host}:{port}: {error}."
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
        status, kind, body = HTTPStatus.NOT_FOUND, "text/plain", b"not found\n"
        if self.server.on_loopback and not self._names_this_machine():
            status, body = HTTPStatus.FORBIDDEN, b"another host name\n"
        elif self.path in ("/", "/index.html"):
            status, kind, body = HTTPStatus.OK, "text/html; charset=utf-8", self.server.page
        elif match := _FILE.fullmatch(self.path):
            root = self.server.result.path.resolve()
            path = resolve_path(root / match[1])
            if path.is_file() and path.is_relative_to(root):  # not through a link that leads out
                status, kind, body = HTTPStatus.OK, _TYPES[path.suffix], path.read_bytes()
        self.send_response(status)
        headers = {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "X-Content-Type-Options": "nosniff",
            "Cache-Control": "no-store",
        }
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        if with_body:
            self.wfile.write(body)

    def _names_this_machine(self) -> bool:
        name = self.headers.get("Host", "").rsplit(":", 1)[0].strip("[]")
        try:
            return name == "localhost" or ipaddress.ip_address(name).is_loopback
        except ValueError:
            return False
