"""Commands and stops that are sent to drives through the gateway that polls them."""
