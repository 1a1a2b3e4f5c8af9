"""The shapes in annotations are those that functions get: conftest has them checked."""

import jaxtyping
import pytest
import torch

from lyapnet.value.calculus import gradients
from tests.problems import Quadratic


@pytest.mark.parametrize("x", [torch.tensor(0.0), torch.zeros(3, 2, dtype=torch.int64)], ids=["no state", "integers"])
def test_another_shape_or_type_is_refused(x):
    V = Quadratic(torch.eye(2))
    gradients(V, torch.tensor(0.0), torch.zeros(3, 2))
    with pytest.raises(jaxtyping.TypeCheckError, match="gradients"):
        gradients(V, torch.tensor(0.0), x)
