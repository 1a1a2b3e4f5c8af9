"""Lightning's door to checkpoint files."""

from typing import Any

from lightning.pytorch.plugins.io import TorchCheckpointIO

from lyapnet.experiment.checkpoint import KEY, read_checkpoint, write_checkpoint

ALONE = "weights_alone"  # of a file that a forked process leaves for the one that started it


class CheckpointFiles(TorchCheckpointIO):
    """Writes all or nothing, and with a digest; verifies it on reading, and executes nothing."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        if "state_dict" not in checkpoint:
            checkpoint = {KEY: {ALONE: True}, "state_dict": checkpoint}
        write_checkpoint(checkpoint, path)

    def load_checkpoint(self, path: Any, map_location: Any = None, weights_only: bool | None = None) -> dict[str, Any]:
        content = read_checkpoint(path, map_location or "cpu")
        return content["state_dict"] if content[KEY].get(ALONE) else content
