"""A movie of a closed loop in MuJoCo's simulator, drawn by MuJoCo."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyapnet.base.errors import UsageError, one_line
from lyapnet.evaluation.in_simulator import Plant
from lyapnet.evaluation.movie import Movie

BRIGHT = 0.8  # ambient light on boxes of inertia, which MuJoCo draws translucent
HEIGHT, WIDTH = 480, 640  # pixels, for which MuJoCo has room by default


def renderer_of(plant: Plant) -> Any:
    """MuJoCo's renderer of a plant, without a window.

    Raises:
        UsageError: there is no library for it.
    """
    try:
        return plant.mujoco.Renderer(plant.model, HEIGHT, WIDTH)
    except Exception as error:  # of many kinds, one for each library
        raise UsageError(
            f"Expected a library by which MuJoCo draws without a window, got none ({one_line(error)[:150]}); set "
            "MUJOCO_GL=egl or MUJOCO_GL=osmesa and install that, or leave out --animation."
        ) from error


class SimulatorMovie(Movie):
    """The bodies of a plant along a closed loop, seen by its first camera, or by MuJoCo's default one.

    A plant without shapes is drawn as the boxes of its inertias.

    Args:
        plant: the MuJoCo model.
        renderer: from `renderer_of`.
        positions: positions of all joints, (N + 1, …).
        duration: duration of the closed loop in seconds.
    """

    def __init__(self, plant: Plant, renderer: Any, positions: NDArray, duration: float, rate: float = 20.0):
        super().__init__(duration, len(positions) - 1, rate, None)
        self.plant, self.renderer, self.positions = plant, renderer, positions

    def frames(self) -> Iterator[np.ndarray]:
        mujoco, model = self.plant.mujoco, self.plant.model
        data, camera, shown = mujoco.MjData(model), 0 if model.ncam else -1, mujoco.MjvOption()
        if not model.ngeom:
            shown.flags[mujoco.mjtVisFlag.mjVIS_INERTIA] = True
            model.vis.headlight.ambient[:] = BRIGHT
        for node in self.nodes:
            data.qpos[:] = self.positions[node]
            mujoco.mj_forward(model, data)
            self.renderer.update_scene(data, camera, shown)
            yield self.renderer.render()
