"""What participant and experimenter are shown of a session, as plain data for their pages.

Pure functions of the session's state and the log.
"""
