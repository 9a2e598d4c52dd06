"""Commands and stops that reach drives through the gateway that polls them."""
