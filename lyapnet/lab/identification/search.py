"""The search for the estimates: fits to short pieces of recordings, then to longer ones, with estimates of the noise.

The model can follow short pieces with any parameters, which give rough estimates; with these it follows longer pieces.
"""

from collections.abc import Sequence

import numpy as np
import torch

from lyapnet.base.errors import LyapnetError, UsageError
from lyapnet.base.names import with_underscores
from lyapnet.experiment.assembly.entries import repeated
from lyapnet.lab.identification.estimation import Fit, Point, Solution
from lyapnet.lab.identification.measurements import Measurements
from lyapnet.lab.identification.shooting import SEGMENT, Shooting
from lyapnet.lab.identification.unknown_system import UnknownSystem
from lyapnet.task.problem import TEST_STATES
from lyapnet.task.systems import states_that_are_rates
from lyapnet.training.stage_messages import StageReport

FIRST_PIECES, SHORTEST = 40, 40  # largest number of pieces of the first fit, and least number of samples of each
FEWEST = 8  # least number of samples of a recording
LONGER = 4  # ratio of the lengths of pieces in successive fits
# A piece ends where an error of its initial state has grown by this factor. Longer ones would seem to determine
# parameters to more digits than is true of any plant, because the model has no disturbances.
GROWTH = 1e3
MOST_UNKNOWNS = 1500  # largest number of parameters and initial states; the time grows with its cube
ROUNDS, SETTLED = 8, 0.01  # largest number of fits with new noise, and its relative change at which they end
LEAST_NOISE = 1e-9  # least standard deviation of readings, relative to their size
ACCURATE = 0.05  # largest error of integration in standard deviations of readings
MOST_SUBSTEPS = 64  # largest number of integration steps between samples
EXACT = 1e-6  # least standard deviation for this test, relative to the size of readings (data without noise)
SMOOTHED = 7  # number of samples over which the rate of a reading is averaged for a first guess
START_BETTER = "start from better values in system.parameters, or correct names and units of columns"

Array = np.ndarray


class Search:
    """The search for the minimum.

    Args:
        unknown: the system.
        recordings: the recordings to fit.
        report: called with the stages of the work.
    """

    def __init__(self, unknown: UnknownSystem, recordings: Sequence[Measurements], report: StageReport):
        self.unknown, self.recordings, self.report = unknown, recordings, report
        self.model, self.readings = unknown.model, unknown.readings
        self.bounds, self.known = unknown.bounds(), self._known_noise()
        k, n, total = len(unknown.names), unknown.system.n, sum(len(each) for each in recordings)
        shortest = min(len(each) for each in recordings)
        if shortest < FEWEST or total * self.readings.count < 2 * (k + n * len(recordings)):
            raise UsageError(
                f"Expected {FEWEST} samples or more in each file, and readings for {k} parameters and {n} states at "
                f"the start of each file, got {shortest} samples and {total * self.readings.count} readings; give "
                "longer files, or a smaller share that is held out."
            )

    def run(self) -> tuple[Fit, Solution]:
        """Fit short pieces, then longer and longer ones, and find the noise on the way."""
        fit, length, start = self._short_pieces()
        longest, found = max(len(each) for each in self.recordings), None
        while length < LONGER * longest:
            self.report("fitting pieces", min(length, longest), longest)
            settled = self._settle(fit, start)
            if settled is None and found is None:
                raise LyapnetError(
                    f"Expected trajectories of the model that follow the data, got others; {START_BETTER}."
                )
            if settled is None:  # trajectories so long cannot be joined
                break
            length, found = LONGER * length, settled
            fit, start = self._longer(*settled, length)
        assert found is not None
        return found

    def shooting(self, pieces: Sequence[Measurements], substeps: int) -> Shooting:
        unknowns = len(self.unknown.names) + self.unknown.system.n * len(pieces)
        if unknowns > MOST_UNKNOWNS:
            raise UsageError(
                f"Expected at most {MOST_UNKNOWNS} unknowns, got {unknowns}: {len(self.unknown.names)} parameters, and "
                f"{self.unknown.system.n} states at the start of {len(pieces)} pieces; give fewer or shorter files."
            )
        return Shooting(self.model, pieces, substeps)

    def _short_pieces(self) -> tuple[Fit, int, Point]:
        """Pieces that the config's model can follow from states near the readings, their length and their start."""
        total = sum(len(each) for each in self.recordings)
        count = max(1, -(-total // (FIRST_PIECES * SEGMENT)), SHORTEST // SEGMENT)  # segments of a piece
        while count:
            pieces = [piece for each in self.recordings for piece in each.pieces(count * SEGMENT)]
            shooting = self.shooting(pieces, 1)
            start = self.start(shooting, self.unknown.before)
            if shooting(start.p, start.x0, start.nodes) is not None:
                sigma = np.where(np.isnan(self.known), self._first_noise(), self.known)
                return (
                    Fit(shooting, sigma, self.bounds, self.unknown.before, self.unknown.spread),
                    count * SEGMENT,
                    start,
                )
            count //= 2
        raise LyapnetError(
            f"Expected data that the config's model can follow for {SEGMENT} samples, got others; {START_BETTER}."
        )

    def start(self, shooting: Shooting, p: Array) -> Point:
        """A first point, with states that are estimated from the readings."""
        states = [self._guess(piece) for piece in shooting.pieces]
        return Point(p, np.stack([x[0] for x in states]), np.concatenate([x[::SEGMENT] for x in states]))

    def _guess(self, piece: Measurements) -> Array:
        """States at all samples, (N, n): readings, their rates, and the centre of X₀ for others."""
        x = np.tile(self.unknown.box.center.double().numpy(), (len(piece), 1))
        measured = {i: k for k, i in enumerate(self.readings.indices) if i < self.unknown.system.n}
        for i, k in measured.items():
            x[:, i] = np.unwrap(piece.y[:, k]) if i in self.unknown.system.angles else piece.y[:, k]
        some = self.unknown.box.sample(TEST_STATES, torch.Generator().manual_seed(0)).double()
        for i, j in states_that_are_rates(self.unknown.system, some):
            if j in measured and i not in measured and len(piece) > 2:
                slope = np.gradient(x[:, j], piece.t)
                width = min(SMOOTHED, (len(piece) - 1) // 2 * 2 + 1)
                x[:, i] = np.convolve(np.pad(slope, width // 2, "edge"), np.full(width, 1 / width), "valid")
        return x

    def _longer(self, fit: Fit, found: Solution, length: int) -> tuple[Fit, Point]:
        """Pieces of a length, or less where an error of the initial state has grown by GROWTH; and where they start."""
        nodes, pieces = found.path.nodes, list[Measurements]()
        scale = np.maximum(np.abs(nodes).max(0), 1e-12)
        transitions = iter(found.path.transitions * scale / scale[:, None])
        for recording in self.recordings:
            begin, grown = 0, np.eye(self.unknown.system.n)
            for end in range(SEGMENT, len(recording), SEGMENT):
                grown = next(transitions) @ grown
                full = end - begin >= length and len(recording) - end >= length // 2
                if full or np.linalg.norm(grown, 2) > GROWTH:
                    pieces.append(recording.part(begin, end))
                    begin, grown = end, np.eye(self.unknown.system.n)
            next(transitions)
            pieces.append(recording.part(begin, len(recording)))
        shooting = self.shooting(pieces, fit.shooting.substeps)
        start = Point(found.point.p, nodes[shooting.first], nodes)
        return Fit(shooting, self.noise(found), self.bounds, self.unknown.before, self.unknown.spread), start

    # Noise

    def _first_noise(self) -> Array:
        """The standard deviation of readings by their third differences, which are small for smooth motion; (q,)."""
        differences = [np.diff(each.y, 3, 0) for each in self.recordings if len(each) > 3]
        found = np.sqrt(np.mean(np.concatenate(differences) ** 2, 0) / 20)
        return np.maximum(found, self._least_noise)

    @property
    def _least_noise(self) -> Array:
        size = np.max([np.abs(each.y).max(0) for each in self.recordings], 0)
        return LEAST_NOISE * np.where(size > 0, size, 1.0)

    def noise(self, found: Solution) -> Array:
        """The standard deviation of each reading, (q,): as known, or estimated from the residuals."""
        freedom = np.maximum(len(found.residuals) - found.leverage, 1.0)
        estimated = np.sqrt((found.residuals**2).sum(0) / freedom)
        return np.where(np.isnan(self.known), np.maximum(estimated, self._least_noise), self.known)

    def _settle(self, fit: Fit, start: Point) -> tuple[Fit, Solution] | None:
        """The minimum with the noise that its residuals have, and with short enough steps; None: no trajectories."""
        size = self._least_noise / LEAST_NOISE
        for _ in range(ROUNDS):
            found, shooting = fit.minimise(start), fit.shooting
            if found is None:
                return None
            start, sigma = found.point, self.noise(found)
            error = shooting.integration_error(found.path, start.p)
            coarse = (error > ACCURATE * np.maximum(sigma, EXACT * size)).any() and shooting.substeps < MOST_SUBSTEPS
            if coarse:
                shooting = self.shooting(shooting.pieces, 2 * shooting.substeps)
            elif (np.abs(sigma / fit.sigma - 1) < SETTLED).all():
                break
            fit = Fit(shooting, sigma, self.bounds, self.unknown.before, self.unknown.spread)
        return fit, found

    def _known_noise(self) -> Array:
        """The standard deviation of each reading that the config knows, NaN for others."""
        outputs, known = self.unknown.config.outputs, np.full(self.readings.count, np.nan)
        if outputs.noise is None:
            return known
        names = list(outputs.measure) or list(self.readings.names)
        if not outputs.measure and self.unknown.system.has_output:
            names = list(
                getattr(self.unknown.system, "output_names", None)
                or [f"reading {k + 1}" for k in range(len(outputs.noise))]
            )
        given = repeated(list(outputs.noise), len(names))
        by_name = {with_underscores(name): value for name, value in zip(names, given, strict=False)}
        return np.array([by_name.get(with_underscores(name), np.nan) for name in self.readings.names])
