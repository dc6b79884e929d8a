"""Statistics of validation sessions: logits with every kind of standard error, preferences, and the paper's tables.

Imports the readers of tables in `study`, and `errors`.
"""
