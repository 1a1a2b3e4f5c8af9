"""Training: data, modules, callbacks, the folder of a run, and its refinement by counterexamples."""
