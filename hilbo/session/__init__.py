"""A participant's session: what is asked next, the state as the fold of a log on disk, plans for whole studies, and the
logs as tables.

Imports `study`, `search` and the model; knows no device and no server.
"""
