"""Lightning's interface to checkpoint files."""

from typing import Any

from lightning.pytorch.plugins.io import TorchCheckpointIO

from lyapnet.experiment.checkpoint import KEY, read_checkpoint, write_checkpoint

WEIGHTS_ONLY_KEY = "weights_alone"  # marks the file of bare weights that a forked process hands to its parent


class CheckpointFiles(TorchCheckpointIO):
    """Writes files atomically with a digest; reading verifies the digest and executes no code."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        if "state_dict" not in checkpoint:
            checkpoint = {KEY: {WEIGHTS_ONLY_KEY: True}, "state_dict": checkpoint}
        write_checkpoint(checkpoint, path)

    def load_checkpoint(self, path: Any, map_location: Any = None, weights_only: bool | None = None) -> dict[str, Any]:
        content = read_checkpoint(path, map_location or "cpu")
        return content["state_dict"] if content[KEY].get(WEIGHTS_ONLY_KEY) else content
