"""Host side of the device: frames, messages, link with heartbeats, transfer of parameter sets, and simulated device.

Imports `mechanics` (for the exponentials of full memory, when they are needed) and `errors`; never JAX on import.
"""
