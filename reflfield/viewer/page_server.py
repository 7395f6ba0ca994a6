"""A page served to the browsers of this machine alone."""

from __future__ import annotations

from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from reflfield.errors import InputError

HOST = "127.0.0.1"
NAMES = (HOST, "localhost")
PORTS = (0, 65535)


class PageServer(ThreadingHTTPServer):
    """Serves one page at ``/``, to this machine.

    Parameters
    ----------
    page : bytes
        HTML in UTF-8.
    port : int
        0 takes one that is free.

    Raises
    ------
    InputError
        If the port is none, or cannot be used.

    Examples
    --------
    >>> with PageServer(b"<!DOCTYPE html>") as server:
    ...     server.url.rpartition(":")[0]
    'http://127.0.0.1'
    """

    daemon_threads = True

    def __init__(self, page: bytes, port: int = 0) -> None:
        if not PORTS[0] <= port <= PORTS[1]:
            raise InputError(f"port: expected {PORTS[0]} to {PORTS[1]}, received {port}")
        self.page = page
        try:
            super().__init__((HOST, port), _PageHandler)
        except OSError as error:
            raise InputError(
                f"port: {port} cannot be used ({error.strerror}); name another, or none"
            ) from error

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self.server_port}/"


class _PageHandler(BaseHTTPRequestHandler):
    server: PageServer

    def do_GET(self) -> None:
        """Answer with the page; nothing else is there."""
        # A page of another name that leads here is of someone who looks for open ports.
        named = self.headers.get("Host", "").rpartition(":")[0] in NAMES
        if not named or self.path != "/":
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(self.server.page)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(self.server.page)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing of each request."""
