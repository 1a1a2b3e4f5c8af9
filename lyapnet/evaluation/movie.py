"""Moving pictures of closed loops: which nodes they show, and their files."""

import io
import math
import shutil
import subprocess
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from lyapnet.base.errors import UsageError, one_line
from lyapnet.base.files import write_atomically

SHORTEST, LONGEST = 3.0, 10.0  # limits in seconds of the default duration of a movie


class Movie(ABC):
    """Frames at a rate, as a GIF or MP4.

    Args:
        duration: duration of the closed loops in seconds.
        steps: number of their steps.
        rate: frames per second.
        speed: seconds of the system per second of the movie; None: 1, adapted to a duration of 3 to 10 s.

    Raises:
        UsageError: rate or speed is no positive number.
    """

    palette: Image.Image | None = None  # the palette of the GIF; None: one for each frame

    def __init__(self, duration: float, steps: int, rate: float, speed: float | None):
        if speed is None:
            speed = duration / min(max(duration, SHORTEST), LONGEST)
        for name, value in (("frames per second", rate), ("speed", speed)):
            if not 0 < value < math.inf:
                raise UsageError(f"Expected {name} > 0, got {value}; as in 20 frames per second at speed 1.")
        self.rate, self.speed = rate, speed
        count = max(2, round(duration / speed * rate) + 1)
        self.nodes: list[int] = np.linspace(0, steps, count).round().astype(int).tolist()

    @abstractmethod
    def frames(self) -> Iterator[np.ndarray]:
        """The frames as (height, width, 3) bytes; both sides are even, as video formats require."""

    def gif(self) -> bytes:
        """The animation as a GIF that repeats."""
        images = (Image.fromarray(frame) for frame in self.frames())
        first, *others = (image.quantize(palette=self.palette, dither=Image.Dither.NONE) for image in images)
        buffer, pause = io.BytesIO(), 1000 / self.rate
        pauses = [round(pause)] * len(others) + [1000]  # the last frame is shown for a second
        first.save(buffer, "GIF", save_all=True, append_images=others, duration=pauses, loop=0, optimize=False)
        return buffer.getvalue()

    def mp4(self) -> bytes:
        """The animation as an MP4 video, made by ffmpeg.

        Raises:
            UsageError: ffmpeg is missing or fails.
        """
        program = shutil.which("ffmpeg")
        if program is None:
            raise UsageError("Expected ffmpeg for an MP4, got none in PATH; install it, or write a .gif.")
        frames = self.frames()
        first = next(frames)
        size = f"{first.shape[1]}x{first.shape[0]}"
        raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(self.rate), "-i", "-"]
        with tempfile.TemporaryDirectory() as folder:
            target = Path(folder, "film.mp4")
            command = [program, "-loglevel", "error", *raw, "-pix_fmt", "yuv420p", str(target)]
            content = b"".join(frame.tobytes() for frame in (first, *frames))
            made = subprocess.run(command, input=content, capture_output=True)
            if made.returncode:
                raise UsageError(f"Expected ffmpeg to make an MP4, got: {one_line(made.stderr.decode())[:200]}.")
            return target.read_bytes()

    def write(self, path: Path) -> None:
        """Write the animation atomically to a .gif or .mp4 file.

        Raises:
            UsageError: the file has another ending, or ffmpeg is missing for an MP4.
            OSError: the file cannot be written.
        """
        require_ending(path)
        write_atomically(path, self.gif() if path.suffix == ".gif" else self.mp4())


def require_ending(path: Path) -> None:
    """Raise UsageError for a file that does not end in .gif or .mp4."""
    if path.suffix not in (".gif", ".mp4"):
        raise UsageError(f"Expected a file that ends in .gif or .mp4, got {str(path)!r}; name it so.")
