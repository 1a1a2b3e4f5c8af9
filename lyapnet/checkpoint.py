"""Checkpoint files: read without executing anything, written so that a crash leaves the previous one."""

import io
import pickle
import warnings
import zipfile
from pathlib import Path
from typing import Any

import torch

from lyapnet.errors import CheckpointError, UsageError
from lyapnet.files import write_atomically

# what torch.load raises on files that it cannot read, by their first bytes
UNREADABLE = (
    RuntimeError, EOFError, LookupError, ValueError, TypeError, AttributeError,
    pickle.UnpicklingError, zipfile.BadZipFile,
)  # fmt: skip
KEY = "lyapnet"  # where a checkpoint keeps the config and the version that wrote it


def read_checkpoint(path: str | Path, device: str | torch.device = "cpu") -> dict[str, Any]:
    """The content of a lyapnet checkpoint.

    Raises:
        UsageError: no such file.
        CheckpointError: truncated, not a checkpoint of lyapnet's, or holding anything but plain data.
    """
    content = read_plain_data(path, device)
    if not isinstance(content, dict) or not all(isinstance(content.get(k), dict) for k in (KEY, "state_dict")):
        raise CheckpointError(
            f"Expected a lyapnet checkpoint, got {str(path)!r}, which another program wrote; use one from logs/."
        )
    return content


def read_plain_data(path: str | Path, device: str | torch.device = "cpu") -> Any:
    """The content of a torch file that holds tensors, numbers, strings, lists and dictionaries only.

    Raises:
        UsageError: no such file.
        CheckpointError: truncated, foreign, or holding anything else; nothing in it was executed.
    """
    path = Path(path)
    if path.is_dir():
        raise UsageError(
            f"Expected a checkpoint file, got the folder {str(path)!r}; in a run's it is checkpoints/best.ckpt."
        )
    if not path.is_file():
        raise UsageError(
            f"Expected a checkpoint file, got {str(path)!r}, which is not there; see logs/*/*/checkpoints."
        )
    try:
        with warnings.catch_warnings():  # about foreign pickles, which are refused below
            warnings.simplefilter("ignore")
            return torch.load(path, map_location=device, weights_only=True)
    except OSError as error:
        raise CheckpointError(f"Expected a readable checkpoint, got {str(path)!r} ({error.strerror}).") from error
    except UNREADABLE as error:
        raise CheckpointError(
            f"Expected a lyapnet checkpoint, got {str(path)!r}, which is truncated or foreign "
            f"({_first_sentence(error)}); use another checkpoint of the run."
        ) from error


def write_checkpoint(content: dict[str, Any], path: str | Path) -> None:
    """Write a checkpoint, all or nothing.

    Raises:
        CheckpointError: the disk is full, the folder cannot be written; the previous file is untouched.
    """
    buffer = io.BytesIO()
    torch.save(content, buffer)
    try:
        write_atomically(Path(path), buffer.getbuffer())
    except OSError as error:
        raise CheckpointError(
            f"Expected to write checkpoint {str(path)!r}, got {error.strerror}; make room and continue with "
            "--resume last: the previous checkpoint is untouched."
        ) from error


def _first_sentence(error: Exception) -> str:
    return str(error).split("\n")[0].split(". ")[0][:120]
