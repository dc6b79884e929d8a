"""The client in a program that runs on asyncio: it says what it would present, and confirms it.

python clients/example_asyncio.py LINK-OF-THE-STIMULUS
"""

import asyncio
import contextlib
import sys

from hilbo_stimulus import Stimulus


async def present(stimulus):
    """Print and confirm orders until the task is cancelled."""
    async for order in stimulus.orders():
        print(order.number, order.do, order.show, dict(order.values), flush=True)
        if order.do == "present":
            await asyncio.to_thread(stimulus.presented)
        else:
            await asyncio.to_thread(stimulus.neutral)


async def main(link):
    """Connect and present orders; other tasks of the loop can run meanwhile."""
    with await asyncio.to_thread(Stimulus, link, "example_asyncio", "1") as stimulus:
        await present(stimulus)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(main(sys.argv[1]))
