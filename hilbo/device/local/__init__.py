"""The firmware on this computer: compiled, as a process behind a pseudo-terminal, or as a library in this process.

For simulated devices, and programs that close the loop themselves.
"""
