"""The number types of ONNX files, and bounds of the rounding errors of onnxruntime in each.

Sources: Higham, "Accuracy and Stability of Numerical Algorithms", chapters 2 to 4, for sums in any order; for functions
the largest measured error of onnxruntime, times a safety factor (docs/trust.md).
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.prover.rounding import mark_rounded

FLOAT, DOUBLE, BOOL, INT64 = 1, 11, 9, 7  # onnx.TensorProto
WHOLE = {  # type of whole numbers in onnx.TensorProto ↦ (least, largest)
    2: (0, 2**8 - 1), 3: (-(2**7), 2**7 - 1), 4: (0, 2**16 - 1), 5: (-(2**15), 2**15 - 1),
    6: (-(2**31), 2**31 - 1), INT64: (-(2**63), 2**63 - 1), 12: (0, 2**32 - 1), 13: (0, 2**64 - 1),
}  # fmt: skip
REPRESENTED = {FLOAT: torch.float64, DOUBLE: torch.float64, BOOL: torch.bool, **dict.fromkeys(WHOLE, torch.int64)}
EXACT = 2**53  # whole numbers up to this size are exact in float64
NAMES = {FLOAT: "float32", DOUBLE: "float64"}


class Format(NamedTuple):
    """A format of floating-point numbers."""

    unit: float  # u, the largest relative rounding error
    least: float  # the smallest normal number; smaller ones may become 0
    largest: float  # the largest number
    functions: dict[str, tuple[float, float]]  # relative and absolute errors of onnxruntime, in units u


FORMATS = {
    FLOAT: Format(
        2.0**-24, 2.0**-126, 3.4e38,
        {
            "Exp": (4, 0), "Log": (12, 0), "Tanh": (12, 0), "Sigmoid": (8, 8), "Softplus": (12, 0), "Sin": (8, 0),
            "Cos": (8, 0), "Tan": (8, 0), "Pow": (4, 0), "Reciprocal": (2, 0), "Sqrt": (2, 0),
        },
    ),
    DOUBLE: Format(
        2.0**-53, 2.0**-1022, 1.79e308,
        {
            "Exp": (4, 0), "Log": (4, 0), "Tanh": (16, 0), "Sigmoid": (8, 8), "Softplus": (12, 4), "Sin": (8, 12),
            "Cos": (8, 12), "Tan": (8, 12), "Pow": (4, 0), "Reciprocal": (2, 0), "Sqrt": (2, 0),
        },
    ),
}  # fmt: skip
LARGEST_ANGLE = 1e9  # bounds of sines beyond are infinite: untested in float64, and meaningless in float32 (rounded x)


class Numbers(NamedTuple):
    """The arithmetic of an operator at a point x.

    Args:
        format: the format of the numbers; None for real numbers.
        point: x.
        moving: for each input of the operator, whether it depends on x.
        weight: Σ |w| over its constant inputs.
    """

    format: Format | None = None
    point: Tensor | None = None
    moving: Sequence[bool] = ()
    weight: float = 0.0

    def rounded(self, y: Tensor, units: float = 1.0, absolute: float = 0.0, lost: float = 1.0) -> Tensor:
        """The result y of an operation with the error units · u |y| + absolute · u + lost · least."""
        if self.format is None or self.point is None:
            return y
        unit, least, largest, _ = self.format
        return mark_rounded(y, self.point, units * unit, absolute * unit + lost * least, largest)

    def function(self, name: str, y: Tensor) -> Tensor:
        """The result y of an elementary function, with its error."""
        return y if self.format is None else self.rounded(y, *self.format.functions[name])

    def limited(self, y: Tensor, largest: float) -> Tensor:
        """y, whose bounds are infinite where |y| may exceed `largest`."""
        exact = self.format is None or self.point is None
        return y if exact else mark_rounded(y, self.point, 0.0, 0.0, largest)  # pyright: ignore[reportArgumentType]

    def summands(self, y: Tensor, terms: int, weight: float = 1.0) -> Tensor:
        """The summands y of sums of `terms` products w_i y_i, Σ |w_i| ≤ weight, with errors that cover those of sums.

        In any order, with or without fused products, the sum is Σ w_i y_i (1 + θ_i) with |θ_i| ≤ γ = k u/(1 − k u),
        where each summand is rounded at most k times.
        """
        if self.format is None or self.point is None:
            return y
        unit, _, largest, _ = self.format
        k = (terms + 2) * unit
        most = largest / max(terms, weight, 1.0)  # below this no partial sum overflows
        return mark_rounded(y, self.point, k / (1 - k), 0.0, most / 2)

    def product(self, a: Tensor, b: Tensor, factor: float = 1.0) -> Tensor:
        """ab of matrices or vectors, with rounded sums, but without the error of underflow.

        Args:
            factor: a number by which products may be multiplied before they are added.
        """
        terms = a.shape[-1]
        if self.format is None:
            return a @ b
        if not all(self.moving[:2]):  # the errors are marked at the factor that depends on x
            weight = self.weight * max(1.0, abs(factor))
            return self.summands(a, terms, weight) @ b if not self.moving[1] else a @ self.summands(b, terms, weight)
        if b.ndim == 1:
            return self.summands(a * b, terms, terms * max(1.0, abs(factor))).sum(-1)
        b = b if a.ndim == 1 else b.unsqueeze(-3)
        return self.summands(a.unsqueeze(-1) * b, terms, terms * max(1.0, abs(factor))).sum(-2)


REAL = Numbers()
