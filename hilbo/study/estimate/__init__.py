"""Estimation: from a cohort to its population map by the study's aggregation method, and the optima of the map.

Computes and describes estimates; writes no files.
"""
