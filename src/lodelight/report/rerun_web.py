"""rerun's web viewer, as the wheel has it, served to this machine alone and with no way out.

The page that rerun serves reports its use to its makers whatever was set beside it, and asks them for fonts and news.
So it is served on, with a Content-Security-Policy by which the browser lets it speak to the run and to nobody else.
"""

from __future__ import annotations

import socket
import threading
import urllib.error
import urllib.request
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import quote

from lodelight.errors import ConfigError

GRPC_PORT, WEB_PORT = 9876, 9090
POLICY = "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' data: blob: {run}"


def serve(rr: Any) -> tuple[Any, str]:
    """A sink for a run, and the address in which a browser shows what goes into it."""
    grpc_port = free_port(GRPC_PORT)
    sink = rr.GrpcServerSink(bind_ip="127.0.0.1", port=grpc_port)
    inner = free_port(0)
    rr.serve_web_viewer(web_port=inner, open_browser=False)
    server = ThreadingHTTPServer(("127.0.0.1", free_port(WEB_PORT)), _handler(inner, f"http://127.0.0.1:{grpc_port}"))
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, name="web viewer", daemon=True).start()
    source = quote(f"rerun+http://127.0.0.1:{grpc_port}/proxy", safe="")
    return sink, f"http://127.0.0.1:{server.server_port}/?url={source}"


def free_port(wanted: int) -> int:
    """This one, or any that is free."""
    for port in (wanted, 0):
        with socket.socket() as s:
            s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                s.bind(("127.0.0.1", port))
            except OSError:
                continue
            return int(s.getsockname()[1])
    raise ConfigError("no port is free for --web")


def _handler(inner: int, run: str) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            path = self.path.partition("?")[0]
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{inner}{path}", timeout=30) as answer:
                    body, kind = answer.read(), answer.headers.get("Content-Type", "application/octet-stream")
            except (urllib.error.URLError, OSError):
                self.send_error(404)
                return
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Content-Security-Policy", POLICY.format(run=run))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *arguments: Any) -> None:
            return

    return Handler
