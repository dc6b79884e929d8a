"""Sessions without people: a simulated participant, and stand-ins for programs and persons that present renderings.

Server, pages and rig are those of a real session.
"""
