"""Session logs as tables: CSV with a Psych-DS description, netCDF.

Made from the logs alone; loads no JAX.
"""
