"""OPC UA server: the drives of a plant as objects with values, units and a method that stops them."""

# names of the nodes that each drive has besides its registers
STATE, FAULT, STOP = MEMBERS = ("State", "Fault", "Stop")
