"""lyapnet systems."""

from rich.console import Console
from rich.table import Column, Table

from lyapnet.cli.options import Debug


def systems(debug: Debug = False) -> None:
    """List the registered systems with their states, controls and parameters; and what else a config can name."""
    import inspect

    from lyapnet.experiment.assembly import REGISTRIES
    from lyapnet.task.systems import BY_EQUATIONS, SYSTEMS

    columns = (Column(name, overflow="fold") for name in ("system", "states", "controls", "parameters (default)"))
    table = Table(*columns, title="system.name in a config")
    for name, cls in SYSTEMS.items():
        parameters = inspect.signature(cls).parameters.values()
        shown = [p.name if p.default is p.empty else f"{p.name}={p.default}" for p in parameters]
        required = any(p.default is p.empty for p in parameters)
        instance = None if required else cls()
        table.add_row(
            name,
            "any number" if instance is None else ", ".join(instance.state_labels),
            "any number" if instance is None else ", ".join(instance.control_labels),
            ", ".join(shown),
        )
    console = Console(highlight=False, markup=False)
    console.print(table)
    console.print(f"system.name of equations, in the config or from a model's file: {', '.join(BY_EQUATIONS)}")
    for part, (registry, _) in REGISTRIES.items():
        if part != "system":
            console.print(f"{part}.name: {', '.join(registry)}", soft_wrap=True)
    console.print("A class of your own: system.name=module:Class, and likewise the others; see the README.")
