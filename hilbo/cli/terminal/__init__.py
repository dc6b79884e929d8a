"""What every command does around its work: float64, caches, progress, a results folder that is whole or absent.

Depends on no command.
"""
