"""Results for readers: result.json, tables, netCDF, figures, and pages that explain themselves.

Reads what `study`, `statistics`, `simulation` and `identification` computed, and fits nothing itself.
"""
