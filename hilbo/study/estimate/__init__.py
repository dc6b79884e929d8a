"""From a cohort to its population map and the optima of it, by the study's rule.

Numbers only: no sentence of a page and no file.
"""
