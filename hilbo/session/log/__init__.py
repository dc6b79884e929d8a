"""The log of a session: its events, the state as their fold, and the file to which each is synced before its answer.

Loads no JAX.
"""
