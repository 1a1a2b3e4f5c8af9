"""Checkpoint files: read without executing anything, written so that a crash leaves the previous one."""

import io
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import torch

from lyapnet.errors import CheckpointError, UsageError

KEY = "lyapnet"  # where a checkpoint keeps the config and the version that wrote it


def read_checkpoint(path: str | Path, device: str | torch.device = "cpu") -> dict[str, Any]:
    """The content of a lyapnet checkpoint: tensors, numbers, strings, lists and dictionaries only.

    Raises:
        UsageError: no such file.
        CheckpointError: truncated, not a checkpoint of lyapnet's, or holding anything but plain data.
    """
    path = Path(path)
    if not path.is_file():
        raise UsageError(
            f"Expected a checkpoint file, got {str(path)!r}, which is not there; see logs/*/version_*/checkpoints."
        )
    try:
        content = torch.load(path, map_location=device, weights_only=True)
    except OSError as error:
        raise CheckpointError(f"Expected a readable checkpoint, got {str(path)!r} ({error.strerror}).") from error
    except (RuntimeError, EOFError, KeyError, ValueError, pickle.UnpicklingError, zipfile.BadZipFile) as error:
        raise CheckpointError(
            f"Expected a lyapnet checkpoint, got {str(path)!r}, which is truncated or foreign "
            f"({_first_sentence(error)}); use another checkpoint of the run."
        ) from error
    if not isinstance(content, dict) or not isinstance(content.get(KEY), dict) or "state_dict" not in content:
        raise CheckpointError(
            f"Expected a lyapnet checkpoint, got {str(path)!r}, which another program wrote; use one from logs/."
        )
    return content


def write_checkpoint(content: dict[str, Any], path: str | Path) -> None:
    """Write all or nothing: to a temporary file beside the target, synchronised, then renamed over it.

    Raises:
        CheckpointError: the disk is full, the folder cannot be written; the previous file is untouched.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    buffer = io.BytesIO()
    torch.save(content, buffer)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            file.write(buffer.getbuffer())
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise CheckpointError(
            f"Expected to write checkpoint {str(path)!r}, got {error.strerror}; make room and continue with "
            "--resume last: the previous checkpoint is untouched."
        ) from error


def _first_sentence(error: Exception) -> str:
    return str(error).split("\n")[0].split(". ")[0][:120]
