"""How well people answer, and how well a rule predicts people who are left out.

Baselines included.
"""
