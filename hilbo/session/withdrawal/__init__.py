"""Withdrawal of a participant: logs, tables, results and plans of a study without this person.

Loads no JAX.
"""
