"""The hierarchical model of many people: a shared function, and a function of each person's own.

Its exact and its low-rank inference.
"""
