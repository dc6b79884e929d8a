"""Sessions without people: a simulated participant, and stand-ins for programs and persons that present.

Real server, real pages, real rig.
"""
