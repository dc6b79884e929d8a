"""Hyperparameters by maximum evidence: the evidence with gradient and Hessian, the coordinates of the search, and the
search.

Imports `ordinal_gp` and what that stands on.
"""
