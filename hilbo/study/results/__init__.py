"""Files of results: result.json, map.nc, groups for ArviZ, and the list of a results folder.

Written with a digest of their numbers and checked when they are read.
"""
