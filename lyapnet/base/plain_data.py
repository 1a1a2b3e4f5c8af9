"""Reading of torch files with plain data only, without executing code of the file."""

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

# errors of torch.load for unreadable files, depending on their first bytes
UNREADABLE = (
    RuntimeError, EOFError, LookupError, ValueError, TypeError, AttributeError,
    pickle.UnpicklingError, zipfile.BadZipFile,
)  # fmt: skip


def plain_data_of(file: io.BytesIO | io.BufferedReader, device: str | torch.device = "cpu") -> Any:
    """Read a file of torch.save that contains only tensors, numbers, strings, lists and dictionaries.

    Raises:
        One of UNREADABLE: it is another kind of file, or its content needs far more memory than the file has bytes, by
            compression, by tensors larger than their storage, or by nested references to the same lists.
    """
    size = file.seek(0, os.SEEK_END)
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise zipfile.BadZipFile("its archive is compressed")
        if sum(entry.file_size for entry in entries) > size:
            raise zipfile.BadZipFile("its archive is larger than the file")
    file.seek(0)
    with warnings.catch_warnings():  # warnings about foreign pickles, which are refused
        warnings.simplefilter("ignore")
        content = torch.load(file, map_location=device, weights_only=True)
    if (needed := _bytes_of(content, {})) > (most := ALLOWANCE + EXPANSION * size):
        raise ValueError(f"it holds {needed:.3g} bytes, more than {most:.3g}")
    return content


ALLOWANCE, EXPANSION = 10**6, 100  # largest memory of a content: bytes, plus a multiple of the file's bytes


def _bytes_of(value: Any, counted: dict[int, int | None]) -> int:
    """The bytes of nested data, where an object counts once for each reference.

    Args:
        counted: id ↦ bytes of containers that were counted already; None while one is being counted.

    Raises:
        ValueError: a container contains itself.
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
