"""Hyperparameters by maximum evidence: evidence with gradient and Hessian, coordinates of the search, and the search.

Imports `ordinal_gp` and its dependencies.
"""
