"""PPO and SAC of Stable-Baselines3 on lyapnet's problems. Needs the extra lyapnet[baselines]."""
