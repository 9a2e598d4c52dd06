"""OPC UA server: the drives of a plant as objects with values, units and a method that stops them."""
