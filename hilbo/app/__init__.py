"""The web pages of a live session: a hub that owns log, rig and choice of trials, and a server for its pages.

`hub` changes the session; `interface` is what its parts may use of it; `rigs` present renderings; `pages` make the data
of the pages; `wire` defines messages and access; `server` speaks HTTP; `rehearsal` runs sessions without people;
`static` has the pages themselves, plain HTML, CSS and JavaScript without a build step.
"""
