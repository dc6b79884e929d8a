"""What participant and experimenter are shown of a session, as plain data for their pages.

It is made from the session's state, log, rig and runner; nothing here changes them.
"""
