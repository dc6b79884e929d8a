"""Dependence of results on the hyperparameters: optima under fixed and optimised ones, and those of a pilot."""
