"""The task: systems, costs, sets, constraints, horizon, and the problem that they make."""
