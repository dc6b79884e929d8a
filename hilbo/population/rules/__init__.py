"""The rules of aggregation: their names, what each assumes and needs, and the recipes of those that learn.

Loads no JAX: study files, the command line and pages ask here too.
"""
