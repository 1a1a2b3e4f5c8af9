"""Certificates from two sides: what the controller costs at most, and what any control costs at least."""

from collections.abc import Mapping
from typing import Any

from lyapnet.claims import figures
from lyapnet.claims.certificates import Certificate
from lyapnet.claims.costs import CostCertificate
from lyapnet.claims.from_below import LowerBoundCertificate
from lyapnet.claims.tables import rows_of
from lyapnet.prover.verdict import Verdict


class TwoSidedCertificate(Certificate):
    """What the controller costs at most, and what any control costs at least."""

    def __init__(self, above: CostCertificate, below: LowerBoundCertificate, options: Mapping[str, Any]):
        super().__init__(above.controller, above.claim, options)
        self.above, self.below, self.kind = above, below, above.kind
        self.picture = above.picture_of_both
        above.options = options  # the seconds are those of both

    @property
    def verdict(self) -> Verdict:
        """On both sides: each holds for all of X₀, and both are about the controller."""
        both = self.above.verdict, self.below.verdict
        if "falsified" in both:
            return "falsified"
        return "unknown" if "unknown" in both or self._apart else "certified"

    @property
    def _apart(self) -> str:
        return self.above.why_apart(self.below.claim)

    def proved(self) -> dict[str, Any]:
        """The numbers of both claims, without the optimum."""
        above, below = self.above, self.below
        return {
            **above.proved(), **above.beside(below.claim), **below.proved(),
            **below.against(above.inside), "seconds": above.claim.seconds + below.claim.seconds,
        }  # fmt: skip

    def numbers(self) -> dict[str, Any]:
        above, below = self.above, self.below
        return {**self.proved(), "guaranteed_cost_ratio": above.cost_ratio, **below.around(above.inside, above.optimum)}

    @property
    def rows(self) -> list[tuple[str, str]]:
        return rows_of(self.result, labels_of_both(type(self.above)))

    def in_words(self) -> str:
        return f"{self.above.in_words()} {self.below.in_words('And from below: ')}"

    def in_formulas(self) -> list[str]:
        return [*self.above.in_formulas(), *self.below.in_formulas()]

    def of_the_verdict(self) -> str:
        both = self.above.of_the_verdict(), self.below.of_the_verdict("And"), self._apart
        return " ".join(filter(None, both))

    def figure(self) -> figures.Figure:
        below, lower = self.below, self.below.claim
        headline = below.headline(self.verdict, self.result.get("certified_ratio"), self.above.in_short(lower))
        return self.above.figure_of_both(lower, below.whose, headline)


def labels_of_both(above: type[CostCertificate]) -> dict[str, str]:
    """The labels of both sides; those of seconds and fingerprints at the end."""
    below = LowerBoundCertificate.labels
    others = {key: label for key, label in {**above.labels, **above.labels_beside}.items() if key not in below}
    return {**others, **below}
