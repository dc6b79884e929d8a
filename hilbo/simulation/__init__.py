"""Simulated participants, validation sessions and studies whose truth is known, and how many people and trials are
enough.

Imports `session` and `study`, and what they stand on.
"""
