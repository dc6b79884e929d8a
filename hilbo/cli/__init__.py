"""The command line: arguments, progress, exit codes, and `hilbo doctor`.

It may import all other folders; none imports it.
"""
