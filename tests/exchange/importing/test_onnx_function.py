"""What is read of an ONNX file, and what is refused: one line for each, and nothing in it is run."""

import numpy as np
import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.exchange.importing.onnx_file import read_onnx, require_same
from lyapnet.exchange.importing.onnx_function import OnnxFunction
from tests.exchange.importing.models import DOUBLE, FLOAT, helper, linear, model_of, onnx, quadratic, saved

pytest.importorskip("onnxruntime")
P = [[2.0, 0.5], [0.5, 1.0]]
STATES = torch.randn(1000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def read(model, path, n=2):
    found = read_onnx(saved(model, path))
    return OnnxFunction(found.proto, n, path.name, rounds=True), found


def refused(model, path, n=2):
    with pytest.raises(UsageError) as error:
        read(model, path, n)
    message = str(error.value)
    assert len(message.splitlines()) == 1
    assert message.startswith("Expected ")
    return message


@pytest.mark.parametrize("options", [{}, {"shape": [1, 2]}, {"opset": 14}, {"opset": 22}])
def test_a_quadratic_form_is_itself(options, tmp_path):
    function, found = read(quadratic(P, **options), tmp_path / "V.onnx")
    expected = ((STATES @ torch.tensor(P)) * STATES).sum(-1)
    torch.testing.assert_close(function(STATES)[:, 0], expected)
    assert require_same(function, found.proto, STATES) < 1e-14


def test_one_state_without_a_batch(tmp_path):
    model = model_of([("MatMul", ["K", "x"], ["y"], {})], {"K": np.array([[1.0, 2.0]])}, shape=[2])
    function, found = read(model, tmp_path / "u.onnx")
    torch.testing.assert_close(function(STATES), STATES @ torch.tensor([[1.0], [2.0]]))
    assert require_same(function, found.proto, STATES) < 1e-14


def test_weights_in_float32_are_the_numbers_that_they_are(tmp_path):
    function, found = read(quadratic([[0.1, 0.0], [0.0, 0.1]], kind=FLOAT), tmp_path / "V.onnx")
    one = function(torch.tensor([[1.0, 0.0]], dtype=torch.float64))
    assert float(one) == float(np.float32(0.1)) != 0.1
    assert 0 < require_same(function, found.proto, STATES) < 1e-6


def test_weights_beside_the_file_count(tmp_path):
    path = tmp_path / "V.onnx"
    model = quadratic(P)
    del model.graph.initializer[0].double_data[:]
    onnx.save(model, str(path), save_as_external_data=True, location="weights.bin", size_threshold=0)
    found = read_onnx(path)
    assert found.digests.keys() == {"V.onnx", "weights.bin"}
    before = OnnxFunction(found.proto, 2, "V.onnx")(STATES)
    content = bytearray((tmp_path / "weights.bin").read_bytes())
    content[7] ^= 0x80  # the sign of its first number
    (tmp_path / "weights.bin").write_bytes(content)
    again = read_onnx(path)
    assert again.digests["weights.bin"] != found.digests["weights.bin"]
    assert not torch.equal(OnnxFunction(again.proto, 2, "V.onnx")(STATES), before)
    (tmp_path / "weights.bin").unlink()
    with pytest.raises(UsageError, match="Expected an ONNX file"):
        read_onnx(path)


def test_weights_elsewhere_are_not_read(tmp_path):
    (tmp_path / "inside").mkdir()
    path = tmp_path / "inside" / "V.onnx"
    onnx.save(quadratic(P), str(path), save_as_external_data=True, location="weights.bin", size_threshold=0)
    (tmp_path / "weights.bin").write_bytes((tmp_path / "inside" / "weights.bin").read_bytes())
    model = onnx.load(str(path), load_external_data=False)
    for each in model.graph.initializer:
        for entry in each.external_data:
            entry.value = "../weights.bin" if entry.key == "location" else entry.value
    path.write_bytes(model.SerializeToString())
    with pytest.raises(UsageError, match="Expected an ONNX file"):
        read_onnx(path)


def test_what_is_no_onnx_is_refused(tmp_path):
    for name, content in {
        "V.onnx": b"\x80nonsense",
        "empty.onnx": b"",
        "V.pt2": b"PK\x03\x04",
        "V.pt": b"\x80\x02.",
    }.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(UsageError, match="Expected an ONNX file") as error:
            read_onnx(path)
        assert ("can run code" in str(error.value)) is name.startswith("V.pt")
    with pytest.raises(UsageError, match=r"No such file"):
        read_onnx(tmp_path / "none.onnx")


def test_a_torch_file_is_not_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    torch.save(Trap(), tmp_path / "V.pt")
    with pytest.raises(UsageError, match="can run code"):
        read_onnx(tmp_path / "V.pt")
    assert not (tmp_path / "sprung").exists()


def test_shapes_that_do_not_fit_are_refused(tmp_path):
    path = tmp_path / "V.onnx"
    assert "an input of 3 states" in refused(quadratic(P), path, n=3)
    assert "free or 1, got (5, 2)" in refused(quadratic(P, shape=[5, 2]), path)
    assert "free or 1, got (1, 1, 2)" in refused(quadratic(P, shape=[1, 1, 2]), path)
    assert "in float32 or float64" in refused(
        model_of([("Neg", ["x"], ["y"], {})], {}, kind=onnx.TensorProto.FLOAT16), path
    )
    two = model_of([("Add", ["x", "t"], ["y"], {})], {}, inputs=("x", "t"))
    assert "one input x and one output in 'V.onnx', got 2 (x, t) and 1" in refused(two, path)
    pair = model_of([("Neg", ["x"], ["y"], {}), ("Abs", ["x"], ["z"], {})], {}, outputs=("y", "z"))
    assert "got 1 (x) and 2" in refused(pair, path)


def test_what_does_not_depend_on_the_state_is_refused(tmp_path):
    constant = model_of([("Shape", ["x"], ["s"], {}), ("ConstantOfShape", ["s"], ["y"], {})], {}, kind=FLOAT)
    assert "Expected a function of x in 'V.onnx', got a constant" in refused(constant, tmp_path / "V.onnx")


def test_unknown_operators_are_named(tmp_path):
    path = tmp_path / "V.onnx"
    assert "got Erf; write the function with these" in refused(model_of([("Erf", ["x"], ["y"], {})], {}), path)
    model = model_of([("Tanh", ["x"], ["y"], {})], {})
    model.graph.node[0].domain = "elsewhere"  # of the name of a known one
    model.opset_import.append(helper.make_opsetid("elsewhere", 1))
    assert "got Tanh" in refused(model, path)
    moving = model_of([("Pow", ["x", "x"], ["y"], {})], {})
    assert "input 1 of Pow in 'V.onnx' as a constant" in refused(moving, path)


def test_functions_within_a_model_are_what_they_say(tmp_path):
    """A function of the model's own may bear the name of an operator; it counts, and not the operator."""
    own = helper.make_function("own", "Tanh", ["a"], ["b"], [helper.make_node("Neg", ["a"], ["b"])],
                               [helper.make_opsetid("", 18)])  # fmt: skip
    model = model_of([("Tanh", ["x"], ["y"], {})], {})
    model.graph.node[0].domain = "own"
    model.opset_import.append(helper.make_opsetid("own", 1))
    model.functions.append(own)
    function, found = read(model, tmp_path / "u.onnx")
    torch.testing.assert_close(function(STATES), -STATES)
    assert require_same(function, found.proto, STATES) == 0


def test_a_function_that_is_not_that_of_onnxruntime_is_refused(tmp_path):
    function, found = read(quadratic(P), tmp_path / "V.onnx")
    with torch.no_grad():
        function.weights[0][0, 0] += 1e-6
    with pytest.raises(UsageError, match=r"within its rounding of what onnxruntime computes, got another result at x"):
        require_same(function, found.proto, STATES)


def test_half_precision_inside_is_refused(tmp_path):
    half = onnx.TensorProto.FLOAT16
    nodes = [("Cast", ["x"], ["h"], {"to": half}), ("Tanh", ["h"], ["z"], {}), ("Cast", ["z"], ["y"], {"to": FLOAT})]
    assert "got another type in Cast; export it in float32" in refused(
        model_of(nodes, {}, kind=FLOAT), tmp_path / "V.onnx"
    )


def test_a_batch_is_read_one_state_at_a_time(tmp_path):
    """What subtracts the mean over the batch is 0 for each state."""
    nodes = [("ReduceMean", ["x", "axis"], ["m"], {}), ("Sub", ["x", "m"], ["y"], {})]
    function, found = read(model_of(nodes, {"axis": np.array([0])}, kind=DOUBLE), tmp_path / "V.onnx")
    assert not function(STATES).any()
    assert require_same(function, found.proto, STATES) == 0


def test_a_copy_has_its_weights(tmp_path):
    function, _ = read(linear([[1.0, 2.0]]), tmp_path / "u.onnx")
    assert sum(each.numel() for each in function.parameters()) == 2
