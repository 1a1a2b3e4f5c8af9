"""Regions of the receding law under pushes of several sizes: claims, their table and their figure."""
