"""Comparison of lyapnet with reinforcement learning and planners: same tasks, same states, one evaluator."""
