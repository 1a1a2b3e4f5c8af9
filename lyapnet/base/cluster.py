"""Connection to a Ray cluster."""

import logging
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from lyapnet.base.errors import UsageError, one_line


@contextmanager
def connect_to_cluster(address: str) -> Iterator[Any]:
    """The module ray, connected to the cluster at an address.

    Args:
        address: as ray.init takes it: auto, local, or ray://host:port.

    Raises:
        UsageError: Ray is not installed, or there is no cluster at the address.
    """
    try:
        import ray
    except ImportError as error:
        raise UsageError("Expected Ray for --ray, got none; pip install 'lyapnet[ray]'.") from error
    _require_listening(address)
    handler = signal.getsignal(signal.SIGTERM)  # ray.init replaces it
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.WARNING)
    except Exception as error:  # ConnectionError, or one of Ray's own errors
        line = one_line(error)
        raise UsageError(f"Expected a Ray cluster at {address!r}, got {type(error).__name__}: {line}") from error
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
    try:
        yield ray
    finally:
        ray.shutdown()


def _require_listening(address: str) -> None:
    """Raise UsageError if nothing listens at host:port; ray.init would try for minutes."""
    place = urlsplit(address if "://" in address else f"//{address}")
    try:
        host, port = place.hostname, place.port
    except ValueError as error:
        raise UsageError(f"Expected a Ray cluster as auto, local or ray://host:port, got {address!r}.") from error
    if host and port:
        try:
            socket.create_connection((host, port), timeout=5).close()
        except OSError as error:
            raise UsageError(
                f"Expected a Ray cluster at {address!r}, got {error.strerror or error}; run ray start --head there."
            ) from error
