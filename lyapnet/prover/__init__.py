"""Proofs that a traced condition holds on boxes: bounds, search, and files that keep a proof."""
