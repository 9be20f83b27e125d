"""A uvicorn server that hangs up on connections which are made while it stops."""

import asyncio
import socket

import uvicorn


class GracefulServer(uvicorn.Server):
    """Ends without waiting for connections that were accepted in the moment it was told to.

    uvicorn asks every connection that it knows to end, and then waits until all have. One that was
    accepted a moment before becomes known a moment later: nobody asks it, and a browser that opens
    connections in advance sends nothing over it either.
    """

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Accept no more, let what was accepted become known, then end as uvicorn does."""
        for server in self.servers:
            server.close()
        for _ in range(2):  # The loop makes a transport in one turn and tells of it in the next.
            await asyncio.sleep(0)
        await super().shutdown(sockets)
