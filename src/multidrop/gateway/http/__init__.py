"""The gateway's HTTP interface: routes, rights and connections."""
