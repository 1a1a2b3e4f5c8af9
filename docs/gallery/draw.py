"""A picture of the gallery, a frame of lyapnet animate: python docs/gallery/draw.py zoo:reacher 0.4 reacher.png."""

import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

controller, share, out = sys.argv[1:]
with tempfile.TemporaryDirectory() as folder:
    film = Path(folder) / "film.gif"
    subprocess.run(["lyapnet", "animate", controller, "--out", film, "--frames-per-second", "10"], check=True)
    picture = Image.open(film)
    picture.seek(round(float(share) * (picture.n_frames - 1)))
    white = picture.convert("RGB").point(lambda level: 255 if level > 250 else level)
white.quantize(128).save(out, optimize=True)
