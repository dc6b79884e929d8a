"""The study file: its schema, what must fit together in it, and the record that is read from it; the plan of sessions.

Loads no JAX, so that plans, logs and devices can be checked at once.
"""
