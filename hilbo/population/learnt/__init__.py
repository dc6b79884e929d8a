"""Recipes that learn the hyperparameters of the hierarchical model from all answers.

A recipe's name is frozen, and so are its numbers.
"""
