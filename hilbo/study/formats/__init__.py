"""Tables and files as text: cells of a CSV or Parquet file, JSON with a type and a digest.

Knows no study and loads no JAX.
"""
