"""Files of results: result.json, map.nc, groups for ArviZ, and the list of files in a results folder.

Some carry a digest of their content, which is checked when they are read.
"""
