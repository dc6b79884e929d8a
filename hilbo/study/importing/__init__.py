"""Import of tables of responses that other programs wrote: recognition, a mapping file, and a trial table.

Loads no JAX.
"""
