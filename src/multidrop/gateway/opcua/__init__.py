"""OPC UA server: each drive is an object with its values, their units, and a method that stops the drive."""

# names of the nodes that each drive has in addition to its registers
STATE, FAULT, STOP = MEMBERS = ("State", "Fault", "Stop")
# ends of node ids after the name of such a node or of a register: none, or a property of this node
PROPERTIES = ("", "EngineeringUnits", "OutputArguments")
