"""The standard recipe: what a config that names no network takes, as its task needs it."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

# What a file without network.name takes: the recipe for a system of which nothing is known. Its own keys come on top,
# a registered program has the weights that it recommends. With constraints, where V is steep, the law looks ahead.
# Muon moves the weights of the value program, but not with limits, of which V_x has kinks: there Adam is the safer one.
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
COSTATE_LIMIT = 5  # that of the recipe, for the value and region programs between limits of the controls
LISTED = "listed"  # name of constraints that has nothing besides those that are listed


def completed(
    content: Mapping[str, Any], overrides: Sequence[str], weights: Callable[[str], Mapping[str, Any]]
) -> Mapping[str, Any]:
    """The content on top of the standard recipe, where it names no network.

    Args:
        content: of a file.
        overrides: of the command line, `key.sub=value`.
        weights: those that a program recommends, by its name.
    """
    sections = {key: content[key] for key in STANDARD if isinstance(content.get(key), Mapping)}
    if "name" in sections.get("network", {}) or len(sections) < sum(key in content for key in STANDARD):
        return content
    recipe = dict(STANDARD)
    constrained = _names(("lower", "upper", "outside", "inside", "name"), "constraints", content, overrides)
    limited = _names(("lower", "upper"), "controls", content, overrides)
    if constrained:
        recipe["rollout"] = {**STANDARD["rollout"], "policy": "lookahead"}
        law = _asked("rollout.policy", {**recipe["rollout"], **sections.get("rollout", {})}["policy"], overrides)
        recipe["network"] = {**STANDARD["network"], "penalty": law == "lookahead"}
    if recipe["rollout"]["policy"] == "lookahead" or _names(("policy",), "rollout", content, overrides):
        recipe["rollout"] = {**recipe["rollout"], "choose_policy": False}
    program, gradient = (
        _asked(f"{part}.{key}", {**STANDARD[part], **sections.get(part, {})}[key], overrides)
        for part, key in (("program", "name"), ("rollout", "gradient"))
    )
    if program == "value" and not constrained and not limited:
        recipe["training"] = {**STANDARD["training"], "optimizer": "muon"}
    if program == "region" or _names(("iterations",), "training", content, overrides):
        # its loss may stay where it is for long, and then fall; a number of steps that somebody asks for is taken
        recipe["training"] = {**recipe["training"], "least_gain": 0.0}
    if program in ("value", "region") and gradient == "discrete" and limited:
        recipe["rollout"] = {**recipe["rollout"], "costate_limit": COSTATE_LIMIT}
    standard = {key: {**section, **sections.get(key, {})} for key, section in recipe.items()}
    return {**content, **standard, "program": {**weights(program), **standard["program"]}}


def _asked(key: str, given: Any, overrides: Sequence[str]) -> str:
    """What the command line says last of a key, and else what is given."""
    return str([given, *(each.partition("=")[2] for each in overrides if each.startswith(f"{key}="))][-1])


def _names(keys: Sequence[str], section: str, content: Mapping[str, Any], overrides: Sequence[str]) -> bool:
    """Whether a file or the command line gives a section one of some keys."""
    written = content.get(section) or {}
    if any(written.get(key) not in (None, {}, [], LISTED) for key in keys):
        return True
    given = (each.partition("=") for each in overrides)
    named = tuple(f"{section}.{key}" for key in keys)
    return any((key == section or key.startswith(named)) and value not in ("", "{}", "null") for key, _, value in given)
