"""Checkpoint files: reading executes no code of the file, writing is atomic.

Each file has a digest of its content, so that damage is detected.
"""

import functools
import hashlib
import io
import logging
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lyapnet.base.errors import CheckpointError, UsageError, one_line
from lyapnet.base.files import require_file, write_atomically
from lyapnet.base.plain_data import UNREADABLE, plain_data_of

KEY = "lyapnet"  # key of the config and of the version that wrote the checkpoint
AFTER_HORIZON = "after_horizon"  # under KEY: the law after T that training found
ZOO = Path(__file__).parents[1] / "zoo"  # the controllers that come with lyapnet, NAME.ckpt with NAME.json
DIGEST = "lyapnet_digest"  # key of digest_of(the other entries); since version 0.3


def locate_checkpoint(path: str | Path) -> Path:
    """The path of a checkpoint: the path itself, or the file of zoo:NAME, a controller that comes with lyapnet.

    Raises:
        UsageError: no such controller; lists the existing ones.
    """
    scheme, separator, name = str(path).partition(":")
    if scheme != "zoo" or not separator or Path(path).exists():
        return Path(path)
    if name not in (known := zoo_names()):
        raise UsageError(f"Expected zoo:NAME with one of {', '.join(known)}, got {str(path)!r}; see lyapnet zoo.")
    return ZOO / f"{name}.ckpt"


def zoo_names() -> list[str]:
    """The names of the controllers that come with lyapnet."""
    return sorted(path.stem for path in ZOO.glob("*.ckpt"))


def read_checkpoint(path: str | Path, device: str | torch.device = "cpu") -> dict[str, Any]:
    """Read a lyapnet checkpoint; the digest is verified and removed.

    For a file without digest, from version 0.1, the checksums of its archive are verified and a note is logged.

    Raises:
        UsageError: no such file.
        CheckpointError: the file is truncated or damaged, no lyapnet checkpoint, or contains more than plain data.
    """
    path = locate_checkpoint(path)
    content = read_plain_data(path, device)
    if not isinstance(content, dict) or not all(isinstance(content.get(k), dict) for k in (KEY, "state_dict")):
        raise CheckpointError(
            f"Expected a lyapnet checkpoint, got {str(path)!r}, which another program wrote; use one from logs/."
        )
    if not _is_as_written(Path(path), content, content.pop(DIGEST, None)):
        raise CheckpointError(
            f"Expected the checkpoint that was written, got {str(path)!r}, which was changed or damaged since; use "
            "another checkpoint of the run, or a copy of this one."
        )
    _add_missing_buffers(content["state_dict"])
    return content


def _add_missing_buffers(weights: dict[str, Any]) -> None:
    """Add the buffer `ends` of expansion networks, which files up to version 0.3 lack; it is 0 for them."""
    for name, tensor in list(weights.items()):
        prefix, _, last = name.rpartition(".")
        if last == "at_goal" and isinstance(tensor, Tensor):
            weights.setdefault(f"{prefix}.ends", torch.zeros_like(tensor))


def digest_of(content: Any) -> str:
    """The SHA-256 of plain data in a canonical form: all keys and values with their types, sorted by key.

    Tensors count by dtype, shape and the bits of their entries; the device does not count.
    """
    digest = hashlib.sha256()
    _update_digest(digest, content)
    return digest.hexdigest()


def _update_digest(digest: Any, value: Any) -> None:
    if isinstance(value, Tensor):
        value = value if value.layout == torch.strided else value.to_dense()
        storage, strides = value.detach(), ()
        if value.nbytes > value.untyped_storage().nbytes():  # an expanded tensor: hash its storage
            strides = (value.stride(), value.storage_offset())
            storage = torch.empty(0, dtype=torch.uint8, device=value.device).set_(value.untyped_storage())
        digest.update(f"tensor {value.dtype} {tuple(value.shape)} {strides};".encode())
        digest.update(storage.cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    elif isinstance(value, Mapping):
        digest.update(f"mapping {len(value)};".encode())
        for key in sorted(value, key=lambda key: (type(key).__name__, repr(key))):
            _update_digest(digest, key)
            _update_digest(digest, value[key])
    elif isinstance(value, list | tuple | set | frozenset):
        digest.update(f"{type(value).__name__} {len(value)};".encode())
        for entry in value if isinstance(value, list | tuple) else sorted(value, key=repr):
            _update_digest(digest, entry)
    else:
        text = repr(value).encode()
        digest.update(f"{type(value).__name__} {len(text)};".encode() + text)


def _is_as_written(path: Path, content: dict[str, Any], digest: Any) -> bool:
    """Whether the content has its digest; for a file without digest, whether its archive has correct checksums."""
    try:
        if digest is not None:
            return digest == digest_of(content)
        with zipfile.ZipFile(path) as archive:
            # torch reads an entry that is marked as a folder as empty, and uses uninitialised memory for its tensor
            intact = archive.testzip() is None and not any(entry.external_attr for entry in archive.infolist())
    except (*UNREADABLE, OSError):  # a hostile file, which torch or zipfile cannot read to the end
        return False
    _note_missing_digest(path)
    return intact


@functools.cache  # only once for each file, which is read several times
def _note_missing_digest(path: Path) -> None:
    logging.getLogger(__name__).warning(
        "note: %s has no digest, because lyapnet 0.1 wrote none; only the checksums of its archive are verified.", path
    )


def read_plain_data(path: str | Path, device: str | torch.device = "cpu") -> Any:
    """Read a torch file that contains only tensors, numbers, strings, lists and dictionaries.

    Raises:
        UsageError: no such file, or a config.
        CheckpointError: the file is truncated, foreign, or contains anything else; no code of it was executed.
    """
    path = Path(path)
    try:
        require_file(path)
    except IsADirectoryError as error:
        raise UsageError(
            f"Expected a checkpoint file, got the folder {str(path)!r}; a run has checkpoints/best.ckpt."
        ) from error
    except FileNotFoundError as error:
        raise UsageError(
            f"Expected a checkpoint file, got {str(path)!r}, which does not exist; see logs/*/*/checkpoints."
        ) from error
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        raise UsageError(
            f"Expected a checkpoint file, got {str(path)!r} ({_describe_error(error)}); use another."
        ) from error
    if path.suffix in (".yaml", ".yml"):
        raise UsageError(
            f"Expected a checkpoint file, got {str(path)!r}, which is a config; train it, and pass "
            "checkpoints/best.ckpt of its run."
        )
    if not path.stat().st_size:
        raise CheckpointError(
            f"Expected a lyapnet checkpoint, got {str(path)!r}, which is empty; use another of the run."
        )
    try:
        with path.open("rb") as file:
            return plain_data_of(file, device)
    except OSError as error:
        raise CheckpointError(
            f"Expected a readable checkpoint, got {str(path)!r} ({error.strerror}); use another."
        ) from error
    except UNREADABLE as error:
        raise CheckpointError(
            f"Expected a lyapnet checkpoint, got {str(path)!r}, which is truncated or foreign "
            f"({_first_sentence(error)}); use another checkpoint of the run."
        ) from error


def write_checkpoint(content: dict[str, Any], path: str | Path) -> None:
    """Write a checkpoint with its digest, atomically.

    Raises:
        CheckpointError: the file cannot be written; the previous file is unchanged.
    """
    buffer = io.BytesIO()
    torch.save({**content, DIGEST: digest_of(content)}, buffer)
    try:
        write_atomically(Path(path), buffer.getbuffer())
    except OSError as error:
        raise CheckpointError(
            f"Expected to write checkpoint {str(path)!r}, got {error.strerror}; make room and continue with --resume "
            f"last: {'the previous checkpoint is untouched' if Path(path).exists() else 'there is no earlier one yet'}."
        ) from error


def note_in_checkpoint(path: str | Path, **notes: Any) -> None:
    """Add plain data to the entry of a checkpoint file that has its config.

    Raises:
        CheckpointError: the file cannot be read or written; it is then unchanged.
    """
    content = read_checkpoint(path)
    write_checkpoint({**content, KEY: {**content[KEY], **notes}}, path)


def _describe_error(error: Exception) -> str:
    """The system's message for a file, or the message of any other error."""
    return getattr(error, "strerror", None) or one_line(error)


def _first_sentence(error: Exception) -> str:
    return str(error).split("\n")[0].split(". ")[0][:120] or type(error).__name__
