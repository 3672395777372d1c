"""The same rows for programs of the cell, while they are made: over a WebSocket (`websocket`) and OPC UA (`opcua`).

A feed runs in a thread of its own. `publish` hands rows over and returns at once: what a client does not take in time
is dropped, never queued, so that nobody who listens holds up who measures.
"""

from torchpose.io.feeds.thread import Feed, Place

__all__ = ["Feed", "Place"]
