"""The command line: arguments, progress, exit codes, and `hilbo doctor`.

May import everything; nothing imports it.
"""
