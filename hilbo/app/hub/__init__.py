"""The hub of a live session: it owns log and state; here too are its runner, interruptions and commands.

Only the hub changes the state; all others request an event from it.
"""
