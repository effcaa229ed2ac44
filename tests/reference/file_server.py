"""A file server on this machine that can break off, ignore Range or change its file."""

from __future__ import annotations

import hashlib
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

CONTENT = bytes(range(256)) * 4096
SHA256 = hashlib.sha256(CONTENT).hexdigest()


class Server:
    """One file, and how the server behaves.

    ``breaks`` holds after how many bytes each of the first connections ends.
    """

    def __init__(
        self,
        content=CONTENT,
        breaks=(),
        ranges=True,
        etag='"one"',
        length=True,
        status=None,
        sends_to=None,
    ):
        self.content, self.breaks, self.ranges, self.etag = content, list(breaks), ranges, etag
        self.length = length
        self.status = status
        self.sends_to = sends_to
        self.asked: list[str | None] = []
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                server.answer(self)

            def log_message(self, *arguments):
                pass

        self.http = HTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.http.server_port}/ngsim.csv"
        self.thread = threading.Thread(target=self.http.serve_forever, daemon=True)

    def answer(self, request):
        self.asked.append(request.headers.get("Range"))
        if self.sends_to:
            request.send_response(302)
            request.send_header("Location", self.sends_to)
            request.end_headers()
            return
        if self.status:
            request.send_error(self.status)
            return
        same = request.headers.get("If-Range") == self.etag
        partial = self.ranges and same and request.headers.get("Range")
        start = int(partial.removeprefix("bytes=").rstrip("-")) if partial else 0
        if partial and start >= len(self.content):
            request.send_error(416)
            return
        request.send_response(206 if partial else 200)
        if partial:
            request.send_header(
                "Content-Range", f"bytes {start}-{len(self.content) - 1}/{len(self.content)}"
            )
        if self.etag:
            request.send_header("ETag", self.etag)
        if self.length:
            length = self.length if isinstance(self.length, str) else str(len(self.content) - start)
            request.send_header("Content-Length", length)
        request.end_headers()
        body = self.content[start:]
        request.wfile.write(body[: self.breaks.pop(0)] if self.breaks else body)

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *error):
        self.http.shutdown()
        self.http.server_close()
        self.thread.join()
