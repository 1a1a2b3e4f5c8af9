"""The config of a training of twelve steps, with horizons of eight, from random weights."""


def small_run(folder, experiment):
    return {
        "logs": str(folder),
        "experiment": experiment,
        "system": {"name": "double_integrator"},
        "cost": {"Q": [1, 1], "R": [1], "Q_T": [1, 1]},
        "initial_states": {"lower": [-1, -1], "upper": [1, 1]},
        "horizon": {"steps": 8, "dt": 0.1},
        "program": {"name": "value", "trajectory_cost": 1},
        "network": {"name": "fcn", "hidden": [8]},
        "rollout": {"gradient": "discrete", "compile": "off"},
        "training": {"iterations": 12, "batch_size": 4, "learning_rate": 0.01, "validate_every": 4},
        "evaluation": {"figures_every": 1000, "optimum": False, "test_states": 4},
        "loggers": ["csv"],
    }
