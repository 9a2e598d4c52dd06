"""Serial and TCP ports on which vendors' tools reach the drives of a line that the gateway polls."""
