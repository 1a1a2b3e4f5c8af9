"""Files of torch that hold plain data only, read without executing anything in them."""

import io
import os
import pickle
import sys
import warnings
import zipfile
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

# What torch.load raises on files that it cannot read, by their first bytes
UNREADABLE = (
    RuntimeError, EOFError, LookupError, ValueError, TypeError, AttributeError,
    pickle.UnpicklingError, zipfile.BadZipFile,
)  # fmt: skip


def plain_data_of(file: io.BytesIO | io.BufferedReader, device: str | torch.device = "cpu") -> Any:
    """What torch.save wrote, of tensors, numbers, strings, lists and dictionaries only; nothing in it is executed.

    Raises:
        One of UNREADABLE: it is another file; or it asks for far more memory than its own size, by compression, by
            tensors that are larger than their storage, or by lists that name one another again and again.
    """
    size = file.seek(0, os.SEEK_END)
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise zipfile.BadZipFile("its archive is compressed")
        if sum(entry.file_size for entry in entries) > size:
            raise zipfile.BadZipFile("its archive is larger than the file")
    file.seek(0)
    with warnings.catch_warnings():  # about foreign pickles, which are refused
        warnings.simplefilter("ignore")
        content = torch.load(file, map_location=device, weights_only=True)
    if (needed := _bytes_of(content, {})) > (most := SMALL + EXPANSION * size):
        raise ValueError(f"it holds {needed:.3g} bytes, more than {most:.3g}")
    return content


SMALL, EXPANSION = 10**6, 100  # bytes, and times the bytes of its file: more than numbers and texts of a file take


def _bytes_of(value: Any, counted: dict[int, int | None]) -> int:
    """The bytes of nested data in which what is named several times counts as often; `counted` has those of its parts.

    Raises:
        ValueError: something contains itself.
    """
    if isinstance(value, Tensor):
        return value.nbytes
    if not isinstance(value, Mapping | list | tuple | set | frozenset):
        return sys.getsizeof(value)
    if id(value) not in counted:
        counted[id(value)] = None
        parts = [*value.keys(), *value.values()] if isinstance(value, Mapping) else value
        counted[id(value)] = sys.getsizeof(value) + sum(_bytes_of(part, counted) for part in parts)
    if (known := counted[id(value)]) is None:
        raise ValueError("a list or dictionary in it contains itself")
    return known
