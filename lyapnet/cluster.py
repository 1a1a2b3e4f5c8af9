"""A Ray cluster, connected to for as long as it is needed."""

import logging
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from lyapnet.errors import UsageError, one_line


@contextmanager
def connected(address: str) -> Iterator[Any]:
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
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.WARNING)
    except Exception as error:  # ConnectionError, or one of its many own
        line = one_line(error)
        raise UsageError(f"Expected a Ray cluster at {address!r}, got {type(error).__name__}: {line}") from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _require_listening(address: str) -> None:
    """Refuse host:port where nothing listens: ray.init tries for minutes."""
    place = urlsplit(address if "://" in address else f"//{address}")
    if place.hostname and place.port:
        try:
            socket.create_connection((place.hostname, place.port), timeout=5).close()
        except OSError as error:
            raise UsageError(
                f"Expected a Ray cluster at {address!r}, got {error.strerror or error}; run ray start --head there."
            ) from error
