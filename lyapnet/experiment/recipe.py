"""The standard recipe: default settings for a config without network.name, adapted to its task."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

# The recipe for an unknown system. The file's own keys have precedence, and a registered program has its recommended
# weights. With constraints, where V is steep, the law is lookahead. The value program uses Muon, but Adam with control
# limits or other costs of controls, where V_x has kinks.
STANDARD: dict[str, Any] = {
    "program": {"name": "value"},
    "network": {"name": "expansion"},
    "rollout": {"policy": "sampled", "choose_policy": True, "gradient": "discrete"},
    "training": {
        "iterations": 400,
        "batch_size": 32,
        "learning_rate": 0.003,
        "warmup": 40,
        "validate_every": 20,
        "lost_share": 0.5,
        "least_gain": 2e-4,
    },
    "trainer": {"gradient_clip_val": 3},
    "evaluation": {"validation_states": 512},
}
COSTATE_LIMIT = 5  # rollout.costate_limit of the recipe, for the value and region programs where V_x has kinks
NOTHING = ("listed", "unbounded")  # constraints.name and controls.name without a class of their own


def with_recipe(
    content: Mapping[str, Any], overrides: Sequence[str], weights: Callable[[str], Mapping[str, Any]]
) -> Mapping[str, Any]:
    """Complete the content of a config by the standard recipe, if it names no network.

    Args:
        content: the content of the file.
        overrides: changes from the command line, `key.sub=value`.
        weights: name of a program ↦ its recommended weights.
    """
    sections = {key: content[key] for key in STANDARD if isinstance(content.get(key), Mapping)}
    if "name" in sections.get("network", {}) or len(sections) < sum(key in content for key in STANDARD):
        return content
    recipe = dict(STANDARD)
    constrained = _sets_any(("lower", "upper", "outside", "inside", "name"), "constraints", content, overrides)
    has_kinks = _sets_any(("lower", "upper", "name"), "controls", content, overrides) or _sets_any(
        ("control_costs",), "cost", content, overrides
    )
    if constrained:
        recipe["rollout"] = {**STANDARD["rollout"], "policy": "lookahead"}
        law = _final_value("rollout.policy", {**recipe["rollout"], **sections.get("rollout", {})}["policy"], overrides)
        recipe["network"] = {**STANDARD["network"], "penalty": law == "lookahead"}
    if recipe["rollout"]["policy"] == "lookahead" or _sets_any(("policy",), "rollout", content, overrides):
        recipe["rollout"] = {**recipe["rollout"], "choose_policy": False}
    program, gradient = (
        _final_value(f"{part}.{key}", {**STANDARD[part], **sections.get(part, {})}[key], overrides)
        for part, key in (("program", "name"), ("rollout", "gradient"))
    )
    if program == "value" and not constrained and not has_kinks:
        recipe["training"] = {**STANDARD["training"], "optimizer": "muon"}
    if program == "region" or _sets_any(("iterations",), "training", content, overrides):
        # no early stopping: the region loss may stay constant for long before it falls, or the user chose iterations
        recipe["training"] = {**recipe["training"], "least_gain": 0.0}
    if program in ("value", "region") and gradient == "discrete" and has_kinks:
        recipe["rollout"] = {**recipe["rollout"], "costate_limit": COSTATE_LIMIT}
    standard = {key: {**section, **sections.get(key, {})} for key, section in recipe.items()}
    return {**content, **standard, "program": {**weights(program), **standard["program"]}}


def _final_value(key: str, given: Any, overrides: Sequence[str]) -> str:
    """The last value of a key on the command line, else the given one."""
    return str([given, *(each.partition("=")[2] for each in overrides if each.startswith(f"{key}="))][-1])


def _sets_any(keys: Sequence[str], section: str, content: Mapping[str, Any], overrides: Sequence[str]) -> bool:
    """Whether the file or the command line sets one of some keys of a section."""
    written = content.get(section) or {}
    if any(written.get(key) not in (None, {}, [], *NOTHING) for key in keys):
        return True
    given = (each.partition("=") for each in overrides)
    named, nothing = tuple(f"{section}.{key}" for key in keys), ("", "{}", "[]", "null", *NOTHING)
    return any((key == section or key.startswith(named)) and value not in nothing for key, _, value in given)
