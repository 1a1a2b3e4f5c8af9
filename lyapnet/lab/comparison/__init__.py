"""Ours against reinforcement learning: the same tasks, the same states, one evaluator."""
