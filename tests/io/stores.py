"""An S3 server on the loopback that answers some requests with an error."""

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

ENVIRONMENT = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "secret-word", "AWS_DEFAULT_REGION": "us-east-1"}


class Unsteady:
    """A WSGI application of which every ``every``-th request fails as S3 does when it is busy."""

    def __init__(self, application: Callable[..., Iterable[bytes]], every: int) -> None:
        self._application, self._every = application, every
        self._lock = threading.Lock()
        self.asked = self.failed = 0

    def __call__(self, environ: dict[str, Any], start: Callable[..., Any]) -> Iterable[bytes]:
        with self._lock:
            self.asked += 1
            fails = self._every > 0 and self.asked % self._every == 0
            self.failed += fails
        if not fails:
            return self._application(environ, start)
        environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
        answer = b"<Error><Code>SlowDown</Code><Message>Please reduce your request rate.</Message></Error>"
        start("503 Slow Down", [("Content-Type", "application/xml"), ("Content-Length", str(len(answer)))])
        return [] if environ["REQUEST_METHOD"] == "HEAD" else [answer]


@contextmanager
def s3_server(bucket: str, *, every: int = 0) -> Iterator[tuple[str, Unsteady]]:
    """URL of a server with an empty bucket, and its application."""
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import make_server

    for backend in _backends():  # which outlive their servers
        backend.reset()
    application = Unsteady(DomainDispatcherApplication(create_backend_app), 0)
    server = make_server("127.0.0.1", 0, application, threaded=True)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    url = f"http://127.0.0.1:{server.server_port}"
    try:
        from pyarrow import fs

        keys = {"access_key": "test", "secret_key": "secret-word", "region": "us-east-1"}
        fs.S3FileSystem(endpoint_override=url, allow_bucket_creation=True, **keys).create_dir(bucket)
        application._every = every
        yield url, application
    finally:
        server.shutdown()
        thread.join()


def put(bucket: str, key: str, data: bytes) -> None:
    """Has a server that runs in this process keep a file, without a request."""
    for backend in _backends():
        if bucket in backend.buckets:
            backend.put_object(bucket, key, data)


def _backends() -> list[Any]:
    """What the servers of this process keep, by account and region."""
    from moto.s3.models import s3_backends

    return [backend for account in s3_backends.values() for backend in account.values()]
