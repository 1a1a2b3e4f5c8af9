"""Notes below the tables of a comparison, which explain the numbers."""

NOTES = (
    "Every method is scored by one evaluator on the same evaluation states of X₀, which no training saw, with its "
    "best checkpoint: a baseline's of least validation cost, ours of least validation loss, in which the cost is a "
    "term.",
    "Environment steps are Euler steps of single trajectories: steps times batch. Validations are not counted. A "
    "baseline's budget is also given as a multiple of our steps in all and to 2 %, and of our seconds in all.",
    "Seconds are CPU time of training alone, on one thread, which is wall-clock time on a core of its own: "
    "validations, figures and checkpoints are left out. Compilation is not: every seed of ours is charged with the "
    "longest that a seed took, although machine code is kept from one to the next.",
    "Validations: the fewest of any seed. Steps and seconds to 10 % and 2 % are those of a validation, and so upper "
    "bounds.",
    "Best validation: of least cost; median over the seeds of its environment steps. At 0 it is the untrained "
    "network. Of ours it is not what is scored. Last validation: what a training without kept checkpoints would have "
    "ended with; mean over the seeds. The best of many noisy validations is also a lucky one: on the evaluation "
    "states it may cost more.",
    "mean ± std: over the seeds, of their means over the states, with n − 1. IQM: mean of the middle half of all "
    "seeds × states, with its 95 % percentile bootstrap interval by resampling seeds (2,000 times, generator seed 0); "
    "of three seeds that is about their range. It leaves out the costliest states of X₀ and so can lie below the mean "
    "optimum; that of J/J*, state by state, does not. Agarwal et al., NeurIPS 2021.",
    "cost / J*: mean cost over mean optimum of the states whose optimum is known. The optimum is that of J_N; of the "
    "sum form it is not computed.",
    "Under noise a cost is the mean over paths of it from a state, the same paths for every method. ± is the "
    "half-width of the 95 % interval of E J for these states and seeds. Above the least: the mean difference on the "
    "same paths from the method that costs least there, which need not be the optimum. J* is then the least expected "
    "cost, known for linear-quadratic tasks alone. LQR and MPC plan as if there were no noise (certainty "
    "equivalence), MPC again at each step; where σ depends on x, LQR's gain and the value that MPC adds at the end of "
    "its horizon know it.",
    "To 10 % and 2 %: the first validation whose cost on the validation states is within that of their optimum; later "
    "ones may be worse again. Median over all the seeds, known where more than half of them got there.",
    "Our convergence: the median over our seeds of the environment steps to 2 %; their mean there may be above. "
    "There, or where its training ended if that was sooner, a method counts with the least cost / optimum so far of "
    "each seed's validation states, a baseline also with its next validation; / ours: over ours at the same step. "
    "Nothing is extrapolated.",
    "Seconds / ours: a baseline's seconds to 10 % over ours. >: too few of its seeds got there within their budget; "
    "one that did not counts with all its training, which bounds the factor from below; a bound below 1 says nothing.",
    "diverged: in some state of so many seeds the closed loop left the finite numbers; inf in the CSV files, ∞ as a "
    "factor.",
    "fail: share of the states, of those whose optimum is known, from which the closed loop costs more than twice as "
    "much or left the finite numbers. Worst state: the greatest J/J* of any state and seed.",
    "Before use: of what learns, seconds of its start, compilation and training, without validations, the search for "
    "lost states and the compilation of its law as machine code; of LQR its Riccati equation; of MPC the reading of "
    "the model, with the import of CasADi. LQR is that of the task linearised at its goal. iLQR plans at t = 0, from "
    "no control and from LQR's, and then follows the better plan. MPC plans at each step, warm-started; what follows "
    "its horizon costs as LQR's value says. All of them know the model, as lyapnet does.",
    "A control: wall-clock time of one state's control on one thread; first: at t = 0, where a planner has no plan "
    "yet. Of lyapnet it is the law as machine code, called from Python, where its law has C, else in Python; of PPO "
    "and SAC their `predict`; of MPC fatrop on functions that CasADi interprets, N stages to the end at 100 % of T. "
    "The 99.9 % of what learns are of 1000 calls with warm caches; a planner is asked between steps of the plant.",
    "Not solved: share of the optimisations of MPC that did not converge; the last iterate is then the plan. Planners "
    "know the limits of a task, and not the action box, to which all controls are cut.",
    "The sum form weighs the running cost 1/Δt times as much as J_N, which every method here minimises: it stands "
    "beside the paper's numbers and ranks nothing.",
    "Clipped: share of controls at the bounds of the action box, in the evaluation.",
    "The paper's rows are those of its Table I (arXiv 2305.15244), their factors computed from its costs. Absolute "
    "costs do not compare with ours: its model and terminal cost differ where its sources do.",
)
