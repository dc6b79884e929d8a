"""The firmware on this computer: compilation, as a process behind a pseudo-terminal, or as a library in this process.

For simulated devices, and for programs that close the control loop themselves.
"""
