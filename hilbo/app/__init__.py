"""The web pages of a live session: a hub that owns log, device and choice, and a server that shows it to two people.

`hub` changes the session, `interface` is what its parts may see and do of it; `rigs` present renderings, `pages` say
what is shown, `wire` what may be sent, `server` speaks HTTP, `rehearsal` needs no people; `static` holds the pages
themselves, plain HTML, CSS and JavaScript without a build step.
"""
