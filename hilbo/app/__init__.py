"""The web pages of a live session: a hub that owns log, device and choice, and a server that shows it to two people.

`hub` is the one place that changes a session; `rig` keeps the device in a thread of its own; `server` speaks HTTP;
`security` says who may ask for what; `static` holds the pages, plain HTML, CSS and JavaScript without a build step.
"""
