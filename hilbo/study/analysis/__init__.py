"""Analyses of one material: credible region, tolerances, comparison of aggregation methods, model check.

Records for reports, tables and figures, which compute nothing themselves.
"""
