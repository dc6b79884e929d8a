"""The log of a session: its events, the state computed from them, and the file to which each event is synced before it
is acknowledged.

Loads no JAX.
"""
