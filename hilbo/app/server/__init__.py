"""The HTTP server of a session: connections, admission, and who is served next.

The hub is all that it knows of the session.
"""
