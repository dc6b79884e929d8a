"""The web pages of a live session: a hub that owns log, device and choice, and a server that shows it to two people.

`hub` is the one place that changes a session; `held` is what its parts, which lead, interrupt, command and show the
session, may see and do of it; `rig` keeps the device in a thread of its own; `server` speaks HTTP;
`security` says who may ask for what; `static` holds the pages, plain HTML, CSS and JavaScript without a build step.
"""
