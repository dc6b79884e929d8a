"""What goes over the connections of a session's server: messages, lines and events, and the keys that permit them.

Knows no HTTP and no hub.
"""
