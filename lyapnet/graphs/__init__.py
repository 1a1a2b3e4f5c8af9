"""Torch functions as flat operator graphs: traced, run by a kernel, and translated to C, CasADi and JavaScript."""
