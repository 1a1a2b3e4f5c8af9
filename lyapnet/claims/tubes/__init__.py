"""Tubes around all closed loops from X₀, proved by reachability: where they go, and what they cost."""
