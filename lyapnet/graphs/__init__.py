"""Torch functions as flat operator graphs: traced, compiled, simplified, bounded on boxes, handed to CasADi."""
