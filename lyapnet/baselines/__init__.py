"""Reinforcement learning on lyapnet's tasks, to compare with. Needs the extra lyapnet[baselines]."""

import gymnasium

from lyapnet.baselines.tasks import IDS

gymnasium.register(id="lyapnet/Task-v0", entry_point="lyapnet.baselines.env:Environment")  # task=… is any
for _name, _id in IDS.items():  # importing this package registers them: gymnasium.make("lyapnet/Reacher-v0")
    gymnasium.register(id=_id, entry_point="lyapnet.baselines.env:Environment", kwargs={"task": _name})
