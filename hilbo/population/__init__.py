"""From people's answers to a population map: the rules that combine posteriors, the hierarchical model, how well people
answer, and what each rule predicts of people left out.

Imports `ordinal_gp`, `bcm` and what they stand on; knows no study and no table.
"""
