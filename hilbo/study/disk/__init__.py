"""Files and folders that appear whole or not at all, and the locks under which they are changed.

Imports nothing of hilbo but its errors, and loads no JAX.
"""
