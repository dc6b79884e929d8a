"""Simulated participants, validation sessions and studies with known truth, and power analysis.

Imports `session` and `study`, and their dependencies.
"""
