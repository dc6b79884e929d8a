"""Response quality of participants, and prediction of participants who are left out.

Baselines included.
"""
