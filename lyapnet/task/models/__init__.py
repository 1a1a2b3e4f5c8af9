"""Models that other programs made, read as equations: CasADi functions, robot descriptions, SymPy expressions."""
