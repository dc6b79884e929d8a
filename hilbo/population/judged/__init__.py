"""Response quality of participants, prediction of participants who are left out, and baselines.

Also hyperparameters that maximise the evidence of participants who are left out, or of one model for all.
"""
