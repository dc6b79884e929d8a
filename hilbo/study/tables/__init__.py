"""Tables of trials, of validation and of parameter sets, read and checked against a study file.

Loads no JAX.
"""
