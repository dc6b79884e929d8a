"""Atomic writing of files and folders, and the locks under which they are changed.

Imports nothing of hilbo but its errors, and loads no JAX.
"""
