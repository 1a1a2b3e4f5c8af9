"""Closed loops of a control law, and what is minimised along them."""
