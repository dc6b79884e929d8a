"""The host's half of the device: frames, messages, the link with its heartbeats, parameter sets on their way, and the
simulated device.

Imports `mechanics` (for the exponentials of full memory, when they are needed) and `errors`; never JAX on import.
"""
