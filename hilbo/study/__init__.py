"""A study as data: its file and tables, the cohort's fits, the population map and optimum, and the analyses of them.

Imports the model, `population`, `hyperparameters` and `search`; knows no session, figure or page.
"""
