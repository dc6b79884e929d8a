"""The study file: its schema, checks of its content, and the record of it; the plan of sessions.

Loads no JAX, so that plans, logs and devices can be checked at once.
"""
