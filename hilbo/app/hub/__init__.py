"""The hub of a live session, which owns log and state, and what leads, interrupts and commands it.

One task changes the state; all others ask it to.
"""
