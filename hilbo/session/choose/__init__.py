"""The choice of the next rendering, from the answers so far; ahead of the answer in a live session.

The compiled parts of a session are here and nowhere else.
"""
