"""Two-sided certificates: an upper bound of the controller's cost, and a lower bound of the cost of any control."""

from collections.abc import Mapping
from typing import Any

from lyapnet.claims import figures
from lyapnet.claims.certificates import Certificate
from lyapnet.claims.costs import CostCertificate
from lyapnet.claims.from_below import LowerBoundCertificate
from lyapnet.claims.tables import rows_of
from lyapnet.prover.verdict import Verdict


class TwoSidedCertificate(Certificate):
    """An upper bound of the controller's cost, and a lower bound of the cost of any control."""

    def __init__(self, above: CostCertificate, below: LowerBoundCertificate, options: Mapping[str, Any]):
        super().__init__(above.controller, above.claim, options)
        self.above, self.below, self.kind = above, below, above.kind
        self.picture = above.picture_of_both
        above.options = options  # their seconds are those of both proofs

    @property
    def verdict(self) -> Verdict:
        """The verdict on the claim that both bounds hold for this controller on all of X₀."""
        both = self.above.verdict, self.below.verdict
        if "falsified" in both:
            return "falsified"
        return "unknown" if "unknown" in both or self._mismatch else "certified"

    @property
    def _mismatch(self) -> str:
        return self.above.mismatch(self.below.claim)

    def proved(self) -> dict[str, Any]:
        """The numbers of both claims, without a comparison with the optimum."""
        above, below = self.above, self.below
        return {
            **above.proved(), **above.beside(below.claim), **below.proved(),
            **below.compare_bounds(above.inside), "seconds": above.claim.seconds + below.claim.seconds,
        }  # fmt: skip

    def numbers(self) -> dict[str, Any]:
        above, below = self.above, self.below
        return {
            **self.proved(),
            "guaranteed_cost_ratio": above.cost_ratio,
            **below.compare_optima(above.inside, above.optimum),
        }

    @property
    def rows(self) -> list[tuple[str, str]]:
        return rows_of(self.result, labels_of_both(type(self.above)))

    def in_words(self) -> str:
        return f"{self.above.in_words()} {self.below.in_words('And from below: ')}"

    def in_formulas(self) -> list[str]:
        return [*self.above.in_formulas(), *self.below.in_formulas()]

    def verdict_text(self) -> str:
        both = self.above.verdict_text(), self.below.verdict_text("And"), self._mismatch
        return " ".join(filter(None, both))

    def figure(self) -> figures.Figure:
        below, lower = self.below, self.below.claim
        headline = below.headline(self.verdict, self.result.get("certified_ratio"), self.above.in_short(lower))
        return self.above.figure_of_both(lower, below.whose, headline)


def labels_of_both(above: type[CostCertificate]) -> dict[str, str]:
    """The table labels of both bounds, with seconds and fingerprints at the end."""
    below = LowerBoundCertificate.labels
    others = {key: label for key, label in {**above.labels, **above.labels_beside}.items() if key not in below}
    return {**others, **below}
