"""What goes over the connections of a session's server: messages, lines and events, and the keys that permit them.

Depends neither on HTTP nor on the hub.
"""
