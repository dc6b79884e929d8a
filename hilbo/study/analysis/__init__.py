"""What the results of one material say: regions, tolerances, comparison of rules, checks of the model.

Records for reports, tables and figures, which compute nothing themselves.
"""
