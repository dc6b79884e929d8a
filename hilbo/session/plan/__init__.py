"""The plan of a study's sessions before the first of them: participants, orders, sets of a validation, seeds.

Loads JAX only for the sets of a validation.
"""
