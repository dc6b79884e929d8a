"""The report of a whole study, `hilbo report`: page, figures, hypotheses, checklist and data dictionary.

The numbers are those of `hilbo.study.analysis.analysis`.
"""
