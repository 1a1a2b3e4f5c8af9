"""Names of states and controls in a config: _ stands for a space wherever they are read."""

import pytest
import yaml

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.assembly.learner import build_value_function
from lyapnet.experiment.assembly.outputs import estimator_parts
from lyapnet.experiment.config import config_from_plain, load_config, to_plain
from lyapnet.value.expansions import in_float64
from tests.problems import untrained

TASK = {
    "experiment": "x", "system": {"name": "cartpole"}, "cost": {"Q": [1, 1, 1, 1], "R": 1, "Q_T": [1, 1, 1, 1]},
    "initial_states": {"lower": -0.1, "upper": 0.1}, "horizon": {"steps": 20, "dt": 0.02},
}  # fmt: skip
SECTIONS = {
    "noise": lambda name: {"noise": {name: 0.1}},
    "target": lambda name: {"target": {name: 0.0}},
    "outputs.measure": lambda name: {"outputs": {"measure": [name], "noise": 0.1}},
    "outputs.process_noise": lambda name: {
        "outputs": {"measure": ["pole angle"], "noise": 0.1, "process_noise": {name: 1}}
    },
    "constraints.upper": lambda name: {"constraints": {"upper": {name: 3}}},
    "constraints.inside": lambda name: {"constraints": {"inside": [{"center": {name: 0}, "radius": 3}]}},
    "domain.lower": lambda name: {"domain": {"lower": {name: -9}}},
    "network.ignored_states": lambda name: {"network": {"ignored_states": [name]}},
    "cost.obstacles": lambda name: {
        "cost": {**TASK["cost"], "obstacles": [{"center": {name: 5}, "radius": 0.3, "weight": 1}]}
    },
}  # fmt: skip
REFUSED = r"outputs\.noise with 2 entries \(cart position, pole angle\), got \[0\.1\]; give one for each"


def built(changes):
    config = config_from_plain({**TASK, **changes})
    problem = build_problem(config)
    parts = estimator_parts(config.outputs, in_float64(problem))
    return problem, parts, build_value_function(config, problem)


@pytest.mark.parametrize("key", SECTIONS)
def test_underscores_stand_for_spaces(key):
    spaced, joined = (built(SECTIONS[key](name)) for name in ("cart position", "cart_position"))
    one, other = spaced[0], joined[0]
    assert repr(one.constraints) == repr(other.constraints)
    assert str(one.domain) == str(other.domain)
    x = one.initial_states.sample(3)
    assert (one.cost.state(x) == other.cost.state(x)).all()
    if spaced[1] is not None:
        assert spaced[1].outputs.names == joined[1].outputs.names
        assert (spaced[1].drift == joined[1].drift).all()
    with pytest.raises(UsageError, match=f"Expected {key}.* among .*, got 'cart-position'; did you mean"):
        built(SECTIONS[key]("cart-position"))


def test_a_state_is_named_once():
    for key in ("noise", "target", "domain.lower", "constraints.upper", "outputs.process_noise"):
        section = content = SECTIONS[key]("cart position")
        while "cart position" not in section:
            section = next(each for each in section.values() if isinstance(each, dict))
        section["cart_position"] = section["cart position"]
        with pytest.raises(UsageError, match=f"Expected {key} with one entry for cart_position, got two; leave"):
            built(content)


@pytest.mark.parametrize("written", ["cart position", "cart_position"])
def test_the_command_line_replaces_an_entry_in_either_spelling(written, tmp_path):
    path = tmp_path / "task.yaml"
    path.write_text(yaml.safe_dump({**TASK, "target": {written: 0.5, "pole angle": 0.0}}))
    for spelling in ("cart position", "cart_position"):
        config = load_config(path, [f"target={{{spelling}: 0.8}}"])
        assert config.target == {spelling: 0.8, "pole angle": 0.0}, "further entries stay"


def test_a_list_of_noise_has_an_entry_for_each_reading(tmp_path):
    path, measure = tmp_path / "task.yaml", ["cart position", "pole angle"]
    for noise, admitted in ((0.1, True), ([0.1, 0.1], True), ([0.1], False)):
        path.write_text(yaml.safe_dump({**TASK, "outputs": {"measure": measure, "noise": noise}}))
        if admitted:
            assert config_from_plain(to_plain(load_config(path))) == load_config(path), "as checkpoints have it"
            continue
        with pytest.raises(UsageError, match=REFUSED):
            load_config(path)
        load_config(path, ["outputs.noise=0.1"])
    path.write_text(yaml.safe_dump({**TASK, "outputs": {"measure": measure, "noise": 0.1}}))
    with pytest.raises(UsageError, match=REFUSED):
        load_config(path, ["outputs.noise=[0.1]"])
    controller = untrained("cartpole_balancing", "network.hidden=[4,4]")
    assert (
        controller.with_estimator(measure=["cart_position", "pole angle"], noise=0.1).outputs.noise.tolist()
        == [0.1] * 2
    )
    with pytest.raises(UsageError, match=REFUSED):
        controller.with_estimator(measure=measure, noise=[0.1])
