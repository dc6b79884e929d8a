"""What presents the renderings of a session: a device, a program, or a person.

One interface, `rig.Rig`; the device has a separate thread.
"""
