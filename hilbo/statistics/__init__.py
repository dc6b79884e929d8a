"""Statistics of validation sessions: logits of the answers with every kind of standard error, preferences, and the
paper's tables.

Imports the readers of tables in `study`, and `errors`.
"""
