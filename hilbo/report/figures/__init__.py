"""Every figure; the only folder that imports matplotlib.

Imports what it draws: records of `study`, `population`, `identification` and the mechanics.
"""
