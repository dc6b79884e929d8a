"""The hierarchical model of many participants: a shared function, and an individual function of each.

Its exact and its low-rank inference.
"""
