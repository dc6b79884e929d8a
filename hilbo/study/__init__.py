"""A study as data: its file and tables, the cohort's fits, the population map and optimum, and everything that results
say of them, computed once.

Imports the model, `population`, `hyperparameters` and `search`; knows no session, figure or page.
"""
