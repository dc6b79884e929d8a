"""Tables of instruments as text cells: where the table is in a file, which column is which quantity, and its times.

Knows no model and loads no JAX.
"""
