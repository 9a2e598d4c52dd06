"""`multidrop fleet demo`: servers, gateways, lines and a hub on this machine; a gateway is killed."""
