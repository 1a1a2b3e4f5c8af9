"""Lightning's door to checkpoint files."""

from typing import Any

from lightning.pytorch.plugins.io import TorchCheckpointIO

from lyapnet.checkpoint import read_checkpoint, write_checkpoint


class CheckpointFiles(TorchCheckpointIO):
    """Writes all or nothing, and with a digest; verifies it on reading, and executes nothing."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        write_checkpoint(checkpoint, path)

    def load_checkpoint(self, path: Any, map_location: Any = None, weights_only: bool | None = None) -> dict[str, Any]:
        return read_checkpoint(path, map_location or "cpu")
