"""A participant's session: choice of the next trial, the event log on disk and the state computed from it, plans for
whole studies, export of logs as tables, and withdrawal.

Imports `study`, `search` and the model, but no device and no server.
"""
