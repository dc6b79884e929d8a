"""The aggregation methods: their names, assumptions and needs, and the recipes of those that learn.

Loads no JAX: study files, the command line and pages use it too.
"""
